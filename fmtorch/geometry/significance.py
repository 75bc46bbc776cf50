"""How far the support of a fundamental matrix is beyond chance: the a contrario test of Moisan and Stival.

L. Moisan, B. Stival: A probabilistic criterion to detect rigid point matches between two images and estimate the
fundamental matrix. IJCV 57 (2004). Suppose that the images show nothing in common, so that the matches of a pair are
independent and their points anywhere. The number of false alarms of a model is how many models with as much support
are to be expected then, in all that a search could have tried.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.batches import for_each_pair
from fmtorch.geometry import significance_kernels as compiled
from fmtorch.geometry.arithmetic import logarithm
from fmtorch.geometry.significance_kernels import SAMPLE


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
        float64, without gradient, computed on the CPU. Minus infinity for fewer than 8 different matches, and for an F
        that is zero or not finite. A pair gets the same bits in any batch and padding; coordinates and sizes scaled or
        shifted together change nothing but by rounding.
    """
    if x0.shape[1] <= SAMPLE:
        return torch.full((len(F),), -torch.inf, dtype=torch.float64, device=F.device)
    mask = torch.ones(x0.shape[:2], dtype=torch.bool, device=x0.device) if mask is None else mask
    sizes = (None if size is None else size.to(torch.float64) for size in (size0, size1))
    out = torch.empty(len(F), 1, dtype=torch.float64)
    return for_each_pair(_into, (F, x0, x1, mask, *sizes), out=out, kind=torch.float64)[:, 0]


def of_one_pair(F: Array, x0: Array, x1: Array, mask: Array, size0: Array, size1: Array) -> float:
    """`significance` of one pair by kernels; float64, sizes empty where unknown."""
    chance = np.empty(len(mask))
    chance = chance[: compiled.counted_chances(F, compiled.Matches(x0, x1, mask, size0, size1), chance)]
    chance.sort()
    return compiled.most_significant(chance, _log_factorials(1 << max(len(mask), SAMPLE + 1).bit_length()))


def _into(F: Array, x0: Array, x1: Array, mask: Array, size0: Array, size1: Array, out: Array) -> None:
    out[0] = of_one_pair(F, x0, x1, mask, size0, size1)


@functools.lru_cache(maxsize=8)
def _log_factorials(count: int) -> Array:
    """log i! (count,) for i = 0 ... count - 1, in ascending order of summation, so that longer tables begin alike.

    For few counts, so that it is seldom made.
    """
    logarithms = logarithm(torch.arange(1, count, dtype=torch.float64))
    return np.concatenate([np.zeros(1), np.cumsum(logarithms.numpy())])
