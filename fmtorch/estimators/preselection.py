"""A round's models compared on few matches first, so that only the best of them are scored on all."""

import dataclasses
import math
from typing import Annotated

import numpy as np

from fmtorch.core.options import Within
from fmtorch.estimators.pair import Pair
from fmtorch.estimators.scores import Score, scored
from fmtorch.geometry.arithmetic import smallest_but, sort_by
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, I8x1, inner, kernel, vector
from fmtorch.jit.random import Stream, random_bits, stream_state

LAST_WORD = (1 << 63) - 1
Count = Annotated[int, Within(1)]
NonNegative = Annotated[int, Within(0)]


@dataclasses.dataclass(frozen=True)
class Preselect:
    """A round's models compared on few matches first.

    matches: any, or for a score that weighs them by their prior such as are drawn by it, each counting as one.
    survivors: models that are scored on all matches."""

    matches: Count = 128
    survivors: Count = 256


class Preselection:
    """Scores a round's models, the weaker ones dropped after a look at few matches.
    score: by which models are compared; its `preselection`, if it has one, on few matches. options: how many matches
    these are, and how many models pass; None: every model is scored on every match."""

    def __init__(self, score: Score, options: Preselect | None) -> None:
        self.score, self.options = score, options
        self.first: Score = getattr(score, "preselection", score)

    def __call__(self, F: Array, pair: Pair) -> tuple[Array, Array]:
        """The indices (k,), ascending, of the models (m, 9) that pass, and their scores (k,) on all matches."""
        which, options = np.arange(len(F)), self.options
        if options is not None and len(F) > options.survivors:
            subset = self.subset(pair)
            if subset is not None:
                first = scored(self.first, F, which, subset)
                which = np.empty(options.survivors, np.int64)
                best(first, which)
        return which, scored(self.score, F, which, pair)

    def subset(self, pair: Pair) -> Pair | None:
        """The pair with the few matches; None where there are not many more.
        A score that weighs matches by their prior gets such as are drawn by it, each of which counts as one."""
        if self.options is None or pair.bucket < 2 * self.options.matches:
            return None
        by_prior, matches = self.score.prior_weighted and pair.prior is not None, self.options.matches
        draw = drawn_by_prior if by_prior else shuffled_first
        return pair.cached(("subset", draw, matches), lambda pair: draw(pair, matches))


def shuffled_first(pair: Pair, count: int) -> Pair:
    """The pair with so many of its matches, in an order that its key decides."""
    index = np.empty(min(count, pair.count), np.int64)
    return pair.take(index[: shuffle(pair.count, pair.mixed_seed(Stream.PRESELECTION), pair.key, index)])


def drawn_by_prior(pair: Pair, count: int) -> Pair:
    """The pair with so many matches drawn by their prior, without replacement; those of any prior count as one.
    They are the first by falling prior / u, u random and uniform, and each stands for as much of the prior: priority
    sampling (Duffield, Lund & Thorup, J. ACM 2007)."""
    index = np.empty(min(count, pair.count), np.int64)
    draw_by_prior(pair.match_weight, pair.mixed_seed(Stream.PRESELECTION), pair.key, index)
    subset = pair.take(index)
    np.greater(subset.match_weight, 0, out=subset.match_weight)
    return subset


@kernel(holds_gil=True)
def best(score: F8x1, out: I8x1) -> None:
    """The indices of the k best of m >= k scores, in ascending order; of equal ones the first -> out (k,)."""
    m, k = len(score), len(out)
    threshold, better = smallest_but(score.copy(), 0, m, m - k), 0
    for i in range(m):
        better += score[i] > threshold
    equal, place = k - better, 0
    for i in range(m):
        if score[i] > threshold or (score[i] == threshold and equal > 0):
            equal -= score[i] == threshold
            out[place] = i
            place += 1


@kernel(holds_gil=True)
def draw_by_prior(prior: F8x1, mixed_seed: int, key: int, out: I8x1) -> None:
    """The matches of the greatest prior / u -> out (k,), ascending; priors (n,)."""
    priority, state = vector(len(prior)), stream_state(mixed_seed, key)
    for i in range(len(prior)):
        priority[i] = prior[i] / (np.float64(random_bits(state, i)) + 1)
    best(priority, out)


@kernel(holds_gil=True)
def shuffle(count: int, mixed_seed: int, key: int, out: I8x1) -> int:
    """The first of so many matches in the order of their random numbers -> out (k,); how many they are."""
    index = np.empty(count, np.int64)
    for i in range(count):
        index[i] = i
    return first_shuffled(index, mixed_seed, key, out)


@inner
def first_shuffled(index: Array, mixed_seed: int, key: int, out: Array) -> int:
    """The first ones of the matches (m,), ascending, in a random order -> out (k,); how many they are."""
    m, kept, state = len(index), 0, stream_state(mixed_seed, key)
    word = np.empty(m, np.int64)
    for i in range(m):
        word[i] = np.int64(random_bits(state, index[i]))
    last = smallest_but(word.copy(), 0, m, len(out) - 1) if 0 < len(out) < m else np.int64(LAST_WORD)
    for i in range(m):
        if word[i] <= last:
            word[kept], index[kept] = word[i], index[i]
            kept += 1
    sort_by(word[:kept], index[:kept])
    kept = min(kept, len(out))
    for i in range(kept):
        out[i] = index[i]
    return kept


# Whether the inliers of a model could determine it: enough of them, and not all on one line

ROUNDINGS = 4.0  # of coordinates, that exact points of a line may lie off it
EXTENT_ROUNDING = 2.0**-23  # the same in units of the points' extent: nobody knows pixels better than a float32 holds
FIRST_LOOK = 256  # matches that mostly suffice to see that there is support
DIRECTION = (0.3819660112501051, 0.7236067977499790, 0.8541019662496845, 0.5278640450004206)
"""Along which different matches are told apart; no simple ratios, so that hardly any two project to one number."""


def degenerate_support(pair: Pair, inliers: Array, minimal: int, rounding: float) -> str:
    """Why the inliers (n,) determine no model; empty where they may. Several at one place in both images count once.
    minimal: the size of a minimal sample; fewer inliers support a model no more than any other. rounding: relative."""
    largest: float = max(map(abs, pair.centre.tolist()))
    rounding *= largest / pair.pixels_per_unit + 1  # in the unit of the points
    on_line = np.empty(2, np.bool_)
    for first in (min(FIRST_LOOK, pair.count), pair.count):
        different = support(pair.points, inliers[:first], minimal, rounding, on_line)
        if different >= minimal and not on_line.any():
            return ""
    if different < minimal:
        return f"the best model has {different} different inliers; at least {minimal} are needed"
    images = " and ".join(f"image {i}" for i in (0, 1) if on_line[i])
    return f"the inliers of the best model lie on one line in {images}"


@kernel(holds_gil=True)
def support(points: F8x2, inliers: B1x1, minimal: int, rounding: float, on_line: B1x1) -> int:
    """How many different ones the inliers (m,) among the first m points (4, n) are, counted up to `minimal`.
    on_line: (2,), whether they lie on one line in each image. rounding: of coordinates, in the unit of the points."""
    index, count = np.empty(len(inliers), np.int64), 0
    for i in range(len(inliers)):
        index[count] = i
        count += inliers[i]
    places, different = vector(minimal), 0
    for i in range(count):
        if different == minimal:
            break
        k, place = index[i], 0.0
        place = points[0, k] * DIRECTION[0] + points[1, k] * DIRECTION[1]
        place = place + points[2, k] * DIRECTION[2] + points[3, k] * DIRECTION[3]
        new = True
        for j in range(different):
            new = new and places[j] != place
        if new:
            places[different] = place
            different += 1
    on_line[0] = count > 0 and _on_line(points[0], points[1], index, count, rounding)
    on_line[1] = count > 0 and _on_line(points[2], points[3], index, count, rounding)
    return different


@inner
def _on_line(x: Array, y: Array, index: Array, count: int, rounding: float) -> bool:
    """Whether points lie on one line, up to rounding: that through the first one and the one farthest from it."""
    ux, uy, longest, across = 0.0, 0.0, -1.0, 0.0
    for i in range(count):
        dx, dy = x[index[i]] - x[index[0]], y[index[i]] - y[index[0]]
        squared = dx * dx + dy * dy
        if squared > longest:
            ux, uy, longest = dx, dy, squared
    for i in range(count):
        dx, dy = x[index[i]] - x[index[0]], y[index[i]] - y[index[0]]
        across = max(across, abs(dx * uy - dy * ux))
    extent = math.sqrt(longest)
    return across <= max(ROUNDINGS * rounding, EXTENT_ROUNDING * extent) * extent
