"""The search: rounds of hypotheses, the best of which are kept, until one was all but surely made of inliers alone.

DEGENSAC completes models that fit a plane alone, by the parallax of the rest."""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fmtorch.estimators.models.fundamental import Hypotheses, Matrices
from fmtorch.estimators.models.with_focals import FundamentalWithFocals
from fmtorch.estimators.pair import Pair, squared
from fmtorch.estimators.preselection import Preselection
from fmtorch.estimators.sampling import PriorWeighted, Sampler, drawn
from fmtorch.estimators.scores import Score, scored
from fmtorch.geometry.homography import least_squares_homography, near_plane, plane_and_parallax, plane_homography
from fmtorch.geometry.matrices import assign, last_right_singular_vector_kernel
from fmtorch.jit.kernel import Array, B1x1, F4x2, F8x1, F8x2, I8x1, I8x2, kernel, vector
from fmtorch.jit.random import Stream, random_bits, stream_state

Stop = Callable[[Array, int, Pair, int], bool]
"""Whether the best model (9,), after so many draws of samples of this size, may be taken for the best there is."""


@dataclasses.dataclass(eq=False)
class Pool:
    """The best models of a pair, F (k, 9) float32 with descending scores (k,), of which `filled` are there.
    samples: minimal samples drawn."""

    F: Array
    score: Array
    filled: int = 0
    samples: int = 0

    @staticmethod
    def empty(size: int) -> "Pool":
        """No model yet."""
        return Pool(np.zeros((size, 9), np.float32), np.full(size, -np.inf))

    @property
    def models(self) -> Array:
        """The models in float64, (m, 9); where there is none one of zeros."""
        return self.F[: max(self.filled, 1)].astype(np.float64)

    def merge(self, models: "Verified") -> None:
        """Keep the best of this pool's models and the new ones; the earlier draw wins a tie."""
        self.filled = merge(models.F, models.which, models.score, self.filled, self.F, self.score)


class Verified(NamedTuple):
    """A round's models (m, 9) float32; the indices `which` (k,) of those that passed, and their scores (k,)."""

    F: Array
    which: Array
    score: Array


@dataclasses.dataclass(frozen=True)
class Search:
    """Rounds of minimal samples: drawn, solved, scored, the best kept. pool: the best models that are kept. hypotheses:
    samples drawn at most. round: samples between two looks at the stopping rule, None: never before `hypotheses`."""

    family: Matrices | FundamentalWithFocals
    sampler: Sampler
    preselection: Preselection
    pool: int
    hypotheses: int
    round: int
    stop: Stop | None = None
    degeneracy: "Degensac | None" = None

    def __call__(self, pair: Pair, start: int = 0) -> Pool:
        """The best models of a pair. start: draws made before."""
        pool, end = Pool.empty(self.pool), start + self.hypotheses
        while start < end:
            count = min(self.round, end - start)
            hypotheses = self.family.solve(pair, drawn(self.sampler, pair, start, count, self.family.size), start)
            models = Verified(hypotheses.F, *self.preselection(hypotheses.F, pair))
            if self.degeneracy is not None:
                models = self.degeneracy(hypotheses, models, float(pool.score[0]), pair)
            start += count
            pool.merge(models)
            pool.samples = start
            if self.stop is None or not pool.filled or start == end:
                continue
            if self.stop(pool.F[0], start, pair, self.family.size):
                break
        return pool


@kernel(holds_gil=True)
def merge(F: F4x2, which: I8x1, score: F8x1, filled: int, pool: F4x2, pool_score: F8x1) -> int:
    """Models F[which] (m, 9) with scores (k,) among the best so far -> pool (p, 9); how many there are.
    filled: places of the pool in use, which are sorted, best first. A score that is not finite is that of no model."""
    for k in range(len(which)):
        if not math.isfinite(score[k]) or (filled == len(pool_score) and not score[k] > pool_score[filled - 1]):
            continue
        place = min(filled, len(pool_score) - 1)
        while place > 0 and pool_score[place - 1] < score[k]:
            pool_score[place] = pool_score[place - 1]
            assign(pool[place], pool[place - 1])
            place -= 1
        pool_score[place] = score[k]
        assign(pool[place], F[which[k]])
        filled = min(filled + 1, len(pool_score))
    return filled


# Scenes ruled by a plane: models that fit the plane alone, recognised and completed by the parallax of the rest

PLANE_THRESHOLD_PX = 2.0  # px, the greater of the two transfer distances up to which a match lies on a plane
PARALLAX_DRAWS = 200  # pairs of matches off a plane
KEPT = 4  # their best models
FITS = 3  # least-squares fits of a plane to its matches, each to those of the last


class Degensac:
    """DEGENSAC (Chum, Werner & Matas, CVPR 2005): the best model so far is checked, and completed if it is degenerate.

    A sample of seven is H-degenerate when at least five of its matches agree with a homography that is compatible with
    the model; five triplets of the sample give all such homographies. The homography of a degenerate model is fitted to
    all its matches, and fundamental matrices of it and two matches off the plane join the models of the round."""

    SAMPLE = 7
    ON_PLANE = 5
    TRIPLETS = np.array([[0, 1, 2], [3, 4, 5], [0, 1, 6], [3, 4, 6], [2, 5, 6]])

    def __init__(self, score: Score) -> None:
        self.score, self.prior = score, PriorWeighted()

    def __call__(self, hypotheses: Hypotheses, models: Verified, best: float, pair: Pair) -> Verified:
        """The verified models of a round, with those of plane and parallax. best: the score to beat."""
        if not len(models.score):  # no sample gave a model
            return models
        first = int(np.argmax(models.score))
        if not models.score[first] > best:
            return models
        which = int(models.which[first])
        sample = np.ascontiguousarray(pair.points[:, hypotheses.sample[:, hypotheses.draw[which]]])
        H = np.empty(9)
        if (
            plane_of_sample(hypotheses.F[which].astype(np.float64), sample, self.TRIPLETS, _limit(pair), H)
            < self.ON_PLANE
        ):
            return models
        F, score = self.completed(H, pair, hypotheses.start)
        added = len(models.F) + np.arange(len(F))
        return Verified(
            np.concatenate([models.F, F]), np.concatenate([models.which, added]), np.concatenate([models.score, score])
        )

    def completed(self, H: Array, pair: Pair, turn: int) -> tuple[Array, Array]:
        """The best models (m, 9) of the plane and two matches off it, float32, and their scores (m,)."""
        on_plane = np.empty(pair.count, np.bool_)
        fit_plane(H, pair.points, _limit(pair), FITS, on_plane)
        weight = np.where(on_plane, 0, self.prior.weight(pair))
        F = np.empty((PARALLAX_DRAWS, 9), np.float32)
        if np.count_nonzero(weight) < 2:
            return F[:0], np.empty(0)
        state = pair.mixed_seed(Stream.PARALLAX), pair.key, 2 * turn * PARALLAX_DRAWS
        F = F[: parallax(H, pair.points, np.cumsum(weight), np.array(state), F)]
        score = scored(self.score, F, np.arange(len(F)), pair)
        kept = np.argsort(-score, kind="stable")[:KEPT]
        return F[kept], score[kept]


def _limit(pair: Pair) -> float:
    """The squared threshold of a plane in normalised units."""
    return squared(PLANE_THRESHOLD_PX / pair.pixels_per_unit)


@kernel
def plane_of_sample(F: F8x1, sample: F8x2, triplets: I8x2, limit: float, H: F8x1) -> int:
    """The homography that is compatible with F and has most matches of its sample -> H (9,); how many these are.
    sample: (4, 7), points. triplets: (t, 3), of the sample, through each of which one homography goes. limit: of
    squared transfer distances. Of equals the first is taken; without any H is zero."""
    G, Ft, e1 = vector(9), vector(9), vector(3)
    near, largest = np.empty(sample.shape[1], np.bool_), 0
    for i in range(9):
        Ft[i], H[i] = F[3 * (i % 3) + i // 3], 0.0
    last_right_singular_vector_kernel(Ft, e1)
    for t in range(len(triplets)):
        if plane_homography(F, e1, sample, triplets[t], G):
            members = near_plane(G, sample, limit, near)
            if members > largest:
                largest = members
                assign(H, G)
    return largest


@kernel
def fit_plane(H: F8x1, points: F8x2, limit: float, fits: int, inside: B1x1) -> None:
    """H (9,), in place, fitted to the matches near it as long as these become more; those matches -> inside (n,)."""
    G, others = vector(9), np.empty(len(inside), np.bool_)
    count = near_plane(H, points, limit, inside)
    for _ in range(fits):
        if not least_squares_homography(points, inside, G):
            break
        more = near_plane(G, points, limit, others)
        if more <= count:
            break
        count = more
        assign(H, G)
        for i in range(len(inside)):
            inside[i] = others[i]


@kernel
def parallax(H: F8x1, points: F8x2, table: I8x1, stream: I8x1, out: F4x2) -> int:
    """Models of a plane and two matches off it -> out (draws, 9); how many there are.
    table: cumulative weights (n,), below 2^31, by which matches are drawn, with replacement. stream: (3,), the mixed
    seed, the key, and the first of the random numbers, two a draw."""
    state, total = stream_state(stream[0], stream[1]), np.uint64(table[-1])
    F, pair, models = vector(9), np.empty(2, np.int64), 0
    for draw in range(len(out)):
        for k in range(2):
            word = random_bits(state, stream[2] + 2 * draw + k) >> np.uint64(31)
            pair[k] = np.searchsorted(table, np.int64(word * total >> np.uint64(32)), side="right")
        if plane_and_parallax(H, points, pair[0], pair[1], F):
            for i in range(9):
                out[models, i] = F[i]
            models += 1
    return models
