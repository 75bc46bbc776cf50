"""How far the support of a fundamental matrix is beyond chance: the a contrario test of Moisan and Stival.

L. Moisan, B. Stival: A probabilistic criterion to detect rigid point matches between two images and estimate the
fundamental matrix. IJCV 57 (2004). Suppose that the images show nothing in common, so that the matches of a pair are
independent and their points anywhere. The number of false alarms of a model is how many models with as much support
are to be expected then, in all that a search could have tried.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Real
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.compiling.batches import for_each_pair, kernels_serve
from fmtorch.geometry import significance_kernels as compiled
from fmtorch.geometry.arithmetic import logarithm, sqrt
from fmtorch.geometry.arithmetic_kernels import LOG10
from fmtorch.geometry.epipolar import epipolar_distances

Array = NDArray[Any]

SAMPLE = 7  # matches that determine a model
MODELS = 3  # of a minimal sample at most
CELLS = 64  # of a grid to the diagonal of an image: matches that join the same two cells are one
LEAST_CHANCE = 2.0**-13  # that a point is near a line: some 0.05 px, beyond which no keypoint is exact
MOST_CELLS = 1 << 15  # of a row or column: a match's four cells make one number of 60 bits
FARTHEST = 1e100  # px; a match beyond is none: numbers made of its coordinates would overflow


@torch.no_grad()
def significance(
    F: Float[Tensor, "b 3 3"],
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    mask: Bool[Tensor, "b n"] | None = None,
    size0: Real[Tensor, "b 2"] | None = None,
    size1: Real[Tensor, "b 2"] | None = None,
) -> Float[Tensor, " b"]:
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

    Returns:
        float64, without gradient. Minus infinity for fewer than 8 different matches, and for an F that is zero or not
        finite. A pair gets the same bits in any batch and padding; coordinates and sizes scaled or shifted together
        change nothing but by rounding.
    """
    if x0.shape[1] <= SAMPLE:
        return torch.full((len(F),), -torch.inf, dtype=torch.float64, device=F.device)
    mask = torch.ones(x0.shape[:2], dtype=torch.bool, device=x0.device) if mask is None else mask
    if kernels_serve(F, x0, x1, mask, size0, size1):
        sizes = (None if size is None else size.to(torch.float64) for size in (size0, size1))
        out = torch.empty(len(F), 1, dtype=torch.float64)
        return for_each_pair(_into, (F, x0, x1, mask, *sizes), out=out, kind=torch.float64)[:, 0]
    mask = mask & (x0.abs() < FARTHEST).all(-1) & (x1.abs() < FARTHEST).all(-1)
    points = [torch.where(mask[..., None], x, 0).to(torch.float64) for x in (x0, x1)]
    valid = torch.isfinite(F).flatten(1).all(1) & (F != 0).flatten(1).any(1)
    F = torch.where(valid[:, None, None], F, 0).to(torch.float64)
    chance = torch.zeros_like(points[0][..., 0])
    place = torch.zeros_like(chance, dtype=torch.int64)
    for x, size, distance in zip(points, (size0, size1), epipolar_distances(F, *points), strict=True):
        low = torch.where(mask[..., None], x, torch.inf).amin(1)
        box = (torch.where(mask[..., None], x, -torch.inf).amax(1) - low).flip(-1).clamp_min(0)
        h, w = (box if size is None else size.to(torch.float64)).unbind(-1)
        diagonal = sqrt(h * h + w * w)
        strip = torch.where(h * w > 0, 2 * diagonal / (h * w), torch.inf)
        chance = torch.maximum(chance, (distance * strip[:, None]).nan_to_num(1.0, 1.0))
        cell = torch.floor((x - low[:, None]) / (diagonal / CELLS)[:, None, None]).nan_to_num(0)
        for column in cell.clamp(0, MOST_CELLS - 1).to(torch.int64).unbind(-1):
            place = place * MOST_CELLS + column
    counted, n = _one_of_each_place(chance.clamp(LEAST_CHANCE, 1.0), place, mask)
    return torch.where(valid, _significance(counted, n), -torch.inf)


def of_one_pair(F: Array, x0: Array, x1: Array, mask: Array, size0: Array, size1: Array) -> float:
    """`significance` of one pair by kernels; float64, sizes empty where unknown."""
    chance = np.empty(len(mask))
    chance = chance[: compiled.counted_chances(F, compiled.Matches(x0, x1, mask, size0, size1), chance)]
    chance.sort()
    return compiled.most_significant(chance, _log_factorials(_table_size(len(mask))))


def _into(F: Array, x0: Array, x1: Array, mask: Array, size0: Array, size1: Array, out: Array) -> None:
    out[0] = of_one_pair(F, x0, x1, mask, size0, size1)


def _table_size(matches: int) -> int:
    """How long a table of log i! is taken: for few sizes, so that it is seldom made."""
    return 1 << max(matches, SAMPLE + 1).bit_length()


def _one_of_each_place(
    chance: Float[Tensor, "b n"], place: Int[Tensor, "b n"], mask: Bool[Tensor, "b n"]
) -> tuple[Float[Tensor, "b n"], Int[Tensor, " b"]]:
    """The median chance of each place (the upper one of two), ascending, then infinities; and how many there are."""
    chance, order = torch.where(mask, chance, torch.inf).sort(1)
    last = torch.iinfo(torch.int64).max
    place, regrouped = torch.where(mask, place, last).gather(1, order).sort(dim=1, stable=True)
    chance = chance.gather(1, regrouped)
    slot = torch.arange(place.shape[1], device=place.device).expand_as(place)
    opens = torch.ones_like(mask)
    opens[:, 1:] = place[:, 1:] != place[:, :-1]
    first = torch.where(opens, slot, 0).cummax(1).values
    size = torch.zeros_like(place).scatter_add_(1, first, torch.ones_like(place)).gather(1, first)
    counted = (slot == first + size // 2) & (place != last)
    return torch.where(counted, chance, torch.inf).sort(1).values, counted.sum(1)


def _significance(chance: Float[Tensor, "b n"], n: Int[Tensor, " b"]) -> Float[Tensor, " b"]:
    """-log10 of the least number of false alarms over k, of ascending chances of which the first n are meant."""
    factorial = torch.from_numpy(_log_factorials(_table_size(chance.shape[1]))).to(chance.device)
    k = torch.arange(SAMPLE + 1, chance.shape[1] + 1, device=chance.device)
    n = n[:, None]
    spare = (n - k).clamp_min(0)
    subsets = factorial[n] - factorial[k] - factorial[spare]
    samples = factorial[k] - factorial[k - SAMPLE] - factorial[SAMPLE]
    tests = _logarithms(factorial)[(n - SAMPLE).clamp_min(1)] + subsets + samples + compiled.LOG_MODELS
    alarms = tests + (k - SAMPLE) * logarithm(chance[:, SAMPLE:].clamp_max(1.0))
    return torch.where(k <= n, -alarms, -torch.inf).amax(1) / LOG10


@functools.lru_cache(maxsize=8)
def _log_factorials(count: int) -> Array:
    """log i! (count,) for i = 0 ... count - 1, in ascending order of summation, so that longer tables begin alike."""
    logarithms = logarithm(torch.arange(1, count, dtype=torch.float64))
    return np.concatenate([np.zeros(1), np.cumsum(logarithms.numpy())])


def _logarithms(factorial: Tensor) -> Tensor:
    """log i from log i!; of 0 that of 1."""
    return torch.cat([factorial[:1], factorial[1:] - factorial[:-1]])
