"""How far the support of a fundamental matrix is beyond chance: the a contrario test of Moisan and Stival.

L. Moisan, B. Stival: A probabilistic criterion to detect rigid point matches between two images and estimate the
fundamental matrix. IJCV 57 (2004). Suppose that the images show nothing in common, so that the matches of a pair are
independent and their points anywhere. The number of false alarms of a model is how many models with as much support
are to be expected then, in all that a search could have tried."""

import functools
import math
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate
from fmtorch.geometry.arithmetic import LOG10, logarithm, logarithm_kernel, smallest_but
from fmtorch.geometry.homography import adjugate
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, for_each_pair, inner, kernel, matrix, vector
from fmtorch.jobs.execution import one_thread

SAMPLE = 7  # matches that determine a model
PLANE_SAMPLE = 4  # of a homography
LOG_PLANE_MODELS = math.log(2.0)  # of both orientations
LOG_MODELS = 1.0986122886681098  # of 3, the models of a minimal sample at most
TINY = 1e-300
CELLS = 64  # of a grid to the diagonal of an image: matches that join the same two cells are one
LEAST_CHANCE = 2.0**-13  # that a point is near a line: some 0.05 px, beyond which no keypoint is exact
MOST_CELLS = 1 << 15  # of a row or column: a match's four cells make one number of 60 bits
FARTHEST = 1e100  # px; a match beyond is none: numbers made of its coordinates would overflow
FREE = -1  # a place of no match: in a slot of the table that is not taken
GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # spreads places over the table


class Matches(NamedTuple):
    """All matches of one pair, x0, x1 (n, 2), and which are real, mask (n,).
    size0, size1: (h, w) of the images, empty where unknown. All in pixels."""

    x0: F8x2
    x1: F8x2
    mask: B1x1
    size0: F8x1
    size1: F8x1


@kernel
def counted_chances(F: F8x2, matches: Matches, plane: bool, out: F8x1) -> int:
    """Of a model F (3, 3) the chances of the matches, the median one of each place, in no order -> out (m,); m.
    plane: it is a homography, whose chances are of discs in place of strips. Without a model m is 0."""
    point, peak = matrix(4, len(matches.mask)), _peak(F)
    count = _real(matches, point) if peak > 0 else 0
    if count <= (PLANE_SAMPLE if plane else SAMPLE):
        return 0
    chance, place = np.zeros(count), np.zeros(count, np.int64)
    strip0 = _placed(point[0], point[1], matches.size0, place)
    strip1 = _placed(point[2], point[3], matches.size1, place)
    if plane:
        _disc_chances(F.ravel() / peak, point, matches, chance)
        return _median_of_places(chance, place, out)
    f0, f1, f2 = F[0, 0] / peak, F[0, 1] / peak, F[0, 2] / peak
    f3, f4, f5 = F[1, 0] / peak, F[1, 1] / peak, F[1, 2] / peak
    f6, f7, f8 = F[2, 0] / peak, F[2, 1] / peak, F[2, 2] / peak
    for i in range(count):
        u, v, x, y = point[0, i], point[1, i], point[2, i], point[3, i]
        a1, b1, c1 = f0 * u + f1 * v + f2, f3 * u + f4 * v + f5, f6 * u + f7 * v + f8
        a0, b0 = f0 * x + f3 * y + f6, f1 * x + f4 * y + f7
        e = abs(a1 * x + b1 * y + c1)
        chance[i] = max(_chance(e, a0 * a0 + b0 * b0, strip0), _chance(e, a1 * a1 + b1 * b1, strip1))
    return _median_of_places(chance, place, out)


@inner
def _disc_chances(h: Array, point: Array, matches: Matches, out: Array) -> None:
    """The chances of matches to be as near to where a homography (9,) maps them -> out (n,)."""
    A, count = vector(9), len(out)
    disc0 = math.pi / _area(point[0, :count], point[1, :count], matches.size0)
    disc1 = math.pi / _area(point[2, :count], point[3, :count], matches.size1)
    adjugate(h, A)
    for i in range(count):
        u, v, x, y = point[0, i], point[1, i], point[2, i], point[3, i]
        in0, in1 = _transfer(A, x, y, u, v) * disc0, _transfer(h, u, v, x, y) * disc1
        larger = max(in0, in1) if in0 < 1 and in1 < 1 else 1.0  # NaN, too
        out[i] = max(larger, LEAST_CHANCE * LEAST_CHANCE)


@inner
def _transfer(H: Array, u: float, v: float, x: float, y: float) -> Any:
    """The squared distance of (x, y) from where H maps (u, v)."""
    depth = H[6] * u + H[7] * v + H[8]
    if depth == 0:
        return math.inf
    dx, dy = (H[0] * u + H[1] * v + H[2]) / depth - x, (H[3] * u + H[4] * v + H[5]) / depth - y
    return dx * dx + dy * dy


@inner
def _area(x: Array, y: Array, size: Array) -> Any:
    """Of an image, or of the box of its points; not zero."""
    return max(size[0] * size[1] if len(size) else (x.max() - x.min()) * (y.max() - y.min()), TINY)


@inner
def _peak(F: Array) -> float:
    """The largest magnitude of a matrix, 0 of one that is not finite."""
    peak = 0.0
    for i in range(9):
        value = F[i // 3, i % 3]
        if not math.isfinite(value):
            return 0.0
        peak = max(peak, abs(value))
    return peak


@inner
def _real(matches: Matches, point: Array) -> int:
    """The coordinates of the matches that are real and not beyond all measure -> point (4, n); how many there are."""
    x0, x1, mask, _, _ = matches
    count = 0
    for i in range(len(mask)):
        a, b, c, d = x0[i, 0], x0[i, 1], x1[i, 0], x1[i, 1]
        if mask[i] and abs(a) < FARTHEST and abs(b) < FARTHEST and abs(c) < FARTHEST and abs(d) < FARTHEST:
            point[0, count], point[1, count], point[2, count], point[3, count] = a, b, c, d
            count += 1
    return count


@inner
def _placed(x: Array, y: Array, size: Array, place: Array) -> Any:
    """Appends the cells of points of an image to the numbers of their places; what turns a distance into a chance."""
    left, top, right, bottom = math.inf, math.inf, -math.inf, -math.inf
    for i in range(len(place)):
        left, right, top, bottom = min(left, x[i]), max(right, x[i]), min(top, y[i]), max(bottom, y[i])
    h, w = (size[0], size[1]) if len(size) else (bottom - top, right - left)
    diagonal = math.sqrt(h * h + w * w)
    side = diagonal / CELLS
    for i in range(len(place)):
        place[i] = (place[i] * MOST_CELLS + _cell((x[i] - left) / side)) * MOST_CELLS + _cell((y[i] - top) / side)
    return 2 * diagonal / (h * w) if h * w > 0 else math.inf


@inner
def _cell(position: float) -> int:
    """The number of a cell; of what is not a number the first, beyond the grid the last."""
    if not position > 0:
        return 0
    return int(position) if position < MOST_CELLS else MOST_CELLS - 1


@inner
def _chance(e: float, squared: float, strip: float) -> float:
    """The chance of a point as near to its line; certain where there is no line, or no image."""
    chance = e * (1 / math.sqrt(squared)) * strip if squared != 0 else 0 * strip
    chance = chance if chance < 1 else 1.0  # NaN, too
    return chance if chance > LEAST_CHANCE else LEAST_CHANCE


@inner
def _median_of_places(chance: Array, place: Array, out: Array) -> int:
    """The median chance of the matches of each place, the upper one of two -> out (m,); how many places there are."""
    n, bits = len(place), 1
    while (1 << bits) < 2 * n:
        bits += 1
    shift, last = np.uint64(64 - bits), (1 << bits) - 1
    table, group, which = np.full(1 << bits, FREE), np.empty(1 << bits, np.int64), np.empty(n, np.int64)
    begin, groups = np.zeros(n + 1, np.int64), 0
    for i in range(n):
        slot = np.int64((np.uint64(place[i]) * GOLDEN) >> shift)
        while table[slot] != FREE and table[slot] != place[i]:
            slot = (slot + 1) & last
        if table[slot] == FREE:
            table[slot], group[slot] = place[i], groups
            groups += 1
        which[i] = group[slot]
        begin[which[i] + 1] += 1
    for g in range(groups):
        begin[g + 1] += begin[g]
    grouped, free = vector(n), begin.copy()
    for i in range(n):
        grouped[free[which[i]]] = chance[i]
        free[which[i]] += 1
    for g in range(groups):
        out[g] = smallest_but(grouped, begin[g], begin[g + 1], (begin[g + 1] - begin[g]) // 2)
    return groups


@kernel(holds_gil=True)
def most_significant(chance: F8x1, factorial: F8x1, sample: int, log_models: float) -> float:
    """-log10 of the least number of false alarms over k, of ascending chances; factorial: log i!, for i to n.
    sample: matches that determine a model, of which there are log_models, a logarithm."""
    n, best = len(chance), -math.inf
    for k in range(sample + 1, n + 1):
        subsets = factorial[n] - factorial[k] - factorial[n - k]
        samples = factorial[k] - factorial[k - sample] - factorial[sample]
        tests = factorial[n - sample] - factorial[n - sample - 1] + subsets + samples + log_models
        best = max(best, -(tests + (k - sample) * logarithm_kernel(chance[k - 1])))
    return best / LOG10


@torch.no_grad()
def significance(
    F: Float[Tensor, "b 3 3"], x0: Float[Tensor, "b n 2"], x1: Float[Tensor, "b n 2"],
    mask: Bool[Tensor, "b n"] | None = None, size0: Real[Tensor, "b 2"] | None = None,
    size1: Real[Tensor, "b 2"] | None = None,
    *, model: str = "fundamental",
) -> Float[Tensor, " b"]:  # fmt: skip
    """-log10 of the number of false alarms of a model: above 0, so much support is not to be expected by chance.

    With the n matches in the order of their distances from the epipolar lines (the larger one of the two images, each
    as the chance that a point anywhere in the image is as near), ``NFA(k) = 3 (n - 7) C(n, k) C(k, 7) p_k^(k - 7)``
    for the first k of them, p_k being the chance of the k-th; the least over k >= 8 counts. So no threshold in pixels
    is needed, and all k that a search could choose, and all samples of 7 of them, are counted.

    Matches are not independent where they crowd. Of those that join one cell of a grid in image 0 to one in image 1
    (64 cells to the diagonal, the grid laid on the box of the matches) the median one alone counts.

    Args:
        F: fundamental matrices in pixels, of any scale.
        x0, x1: all matches that an estimator was given, right and wrong, in pixels.
        mask: which are real; all when not given.
        size0, size1: image sizes (h, w), in pixels. Without them points are taken to lie anywhere in the box of the
            matches.
        model: "homography" for F that are homographies, ``x1 ~ F x0``: p_k is then the chance that a point anywhere is
            as near to where its match is mapped, a sample has 4 matches and 2 models, those of both orientations.

    Returns:
        float64, without gradient, computed on the CPU. Minus infinity for fewer than 8 different matches, and for an F
        that is zero or not finite. A pair gets the same bits in any batch and padding; coordinates and sizes scaled or
        shifted together change nothing but by rounding.
    """
    if x0.shape[1] <= (PLANE_SAMPLE if model == "homography" else SAMPLE):
        return torch.full((len(F),), -torch.inf, dtype=torch.float64, device=F.device)
    mask = torch.ones(x0.shape[:2], dtype=torch.bool, device=x0.device) if mask is None else mask
    sizes = (None if size is None else size.to(torch.float64) for size in (size0, size1))
    out = torch.empty(len(F), 1, dtype=torch.float64)

    def into(F: Array, x0: Array, x1: Array, mask: Array, size0: Array, size1: Array, out: Array) -> None:
        out[0] = of_one_pair(F, x0, x1, mask, size0, size1, model)

    return for_each_pair(into, (F, x0, x1, mask, *sizes), out=out, kind=torch.float64)[:, 0]


def of_one_pair(
    F: Array, x0: Array, x1: Array, mask: Array, size0: Array, size1: Array, model: str = "fundamental"
) -> float:
    """`significance` of one pair by kernels; float64, sizes empty where unknown."""
    chance, matches, plane = np.empty(len(mask)), Matches(x0, x1, mask, size0, size1), model == "homography"
    factorials = _log_factorials(1 << max(len(mask), SAMPLE + 1).bit_length())
    chance = chance[: counted_chances(F, matches, plane, chance)]
    chance.sort()
    sample, log_models = (PLANE_SAMPLE, LOG_PLANE_MODELS) if plane else (SAMPLE, LOG_MODELS)
    return most_significant(chance, factorials, sample, log_models)


@functools.lru_cache(maxsize=8)
def _log_factorials(count: int) -> Array:
    """log i! (count,) for i = 0 ... count - 1, summed in ascending order, so that longer tables begin alike."""
    return np.concatenate([np.zeros(1), np.cumsum(logarithm(torch.arange(1, count, dtype=torch.float64)).numpy())])


def judged(estimate: Estimate, c: Correspondences) -> Estimate:
    """The estimate with its significance, where the estimator has not given one.

    Args:
        estimate: of anybody's estimator.
        c: the matches that it was given, all of them: an estimate from a choice of them must not be judged by these.

    Returns:
        The same with `significance`, minus infinity where it is not ok.
    """
    given = cast(Tensor, estimate.significance)
    unknown = given.isnan()
    if not bool(unknown.any()):
        return estimate
    with one_thread(c.mask.device):
        F, x0, x1 = estimate.matrix.detach(), c.x0.detach(), c.x1.detach()
        computed = significance(F, x0, x1, c.mask, c.size0, c.size1, model=estimate.model)
    computed = torch.where(estimate.ok, computed, -torch.inf)
    return estimate.derived(significance=torch.where(unknown, computed, given))
