"""How exact is each match? Noise from the keypoint's size, the distance ratio and the prior."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.records import ungraphed
from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.jit.batches import for_each_pair, kernels_serve
from fmtorch.jit.kernel import B1x1, F4x1, F4x3, inner, kernel

# `match_noise` for one pair, compiled: the same bits


ONE32 = np.float32(1)


class FramedMatches(NamedTuple):
    """The matches of one pair: frames lafs0, lafs1 (n, 2, 3), pixels, and which are real, mask (n,).

    quality, prior: (n,), empty where unknown.
    """

    lafs0: F4x3
    lafs1: F4x3
    quality: F4x1
    prior: F4x1
    mask: B1x1


@kernel
def match_noise_kernel(matches: FramedMatches, numbers: F4x1, out: F4x1) -> None:
    """`MatchNoise` of n matches -> out (n,); one where masked or where it cannot be told.

    numbers: usual, radius in pixels, slope, least area in square pixels, least prior.
    """
    lafs0, lafs1, quality, prior, mask = matches
    usual, radius, slope, min_area, min_prior = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    for i in range(len(mask)):
        size = max(_scale_kernel(lafs0, i, min_area), _scale_kernel(lafs1, i, min_area))
        noise = (ONE32 + size / radius) / usual
        valid = mask[i] and _finite(lafs0, i) and _finite(lafs1, i)
        if len(quality):
            valid = valid and math.isfinite(quality[i])
            factor = ONE32 + slope * quality[i]
            noise *= factor * factor
        if len(prior):
            valid = valid and math.isfinite(prior[i])
            noise /= math.sqrt(math.sqrt(max(prior[i], min_prior)))
        out[i] = noise if valid else ONE32


@inner
def _scale_kernel(lafs: F4x3, i: int, min_area: np.float32) -> float:
    """The square root of the area that frame i maps the unit square to."""
    return math.sqrt(max(abs(lafs[i, 0, 0] * lafs[i, 1, 1] - lafs[i, 0, 1] * lafs[i, 1, 0]), min_area))


@inner
def _finite(lafs: F4x3, i: int) -> bool:
    """Whether all numbers of frame i are finite."""
    finite = True
    for row in range(2):
        for column in range(3):
            finite = finite and math.isfinite(lafs[i, row, column])
    return finite


MIN_AREA = 1e-12  # square pixels: keeps the gradient of the scale finite
MIN_PRIOR = 0.02  # matches less likely than that are not taken for noisier


def match_noise(
    lafs0: Float[Tensor, "b n 2 3"],
    lafs1: Float[Tensor, "b n 2 3"],
    quality: Float[Tensor, "b n"] | None = None,
    prior: Float[Tensor, "b n"] | None = None,
    *,
    usual: float,
    radius: float,
    slope: float,
) -> Float[Tensor, "b n"]:
    """Standard deviation of each match's distance to its epipolar line, in units of a usual match's.

    ``(1 + s / radius) (1 + slope ratio)^2 P^(-1/4) / usual`` with s the larger of the two frames' scales in pixels: a
    keypoint is located to a share of its size, and matches that are hard to tell apart, or that their neighbours
    contradict somewhat, are less exact. Arithmetic and roots alone, which are rounded in the same way everywhere.
    """
    size = torch.maximum(_scale(lafs0), _scale(lafs1))
    noise = (1 + size / radius) / usual
    if quality is not None:
        noise = noise * (1 + slope * quality).square()
    if prior is not None:
        noise = noise / sqrt(sqrt(prior.clamp_min(MIN_PRIOR)))
    return noise


def _scale(lafs: Float[Tensor, "b n 2 3"]) -> Float[Tensor, "b n"]:
    """The square root of the area that a frame maps the unit square to, pixels."""
    (a, b), (c, d) = (row.unbind(-1) for row in lafs[..., :2].unbind(-2))
    return sqrt((a * d - b * c).abs().clamp_min(MIN_AREA))


@dataclasses.dataclass(frozen=True)
class MatchNoise:
    """Supplies ``noise`` by `match_noise`; matches without frames are left as they are.

    `Ransac` divides each match's residual by it, in its scores (but not that of the median) and in its
    non-linear fits; the 8-point algorithm, the `irls_*` estimators and other libraries do not look at it. Inliers are
    reported by their distance in pixels all the same. usual, radius, slope: see `match_noise`.
    """

    usual: float
    radius: float
    slope: float

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches with their noise; one where masked or where it cannot be told."""
        lafs0, lafs1 = c.lafs0, c.lafs1
        if lafs0 is None or lafs1 is None:
            return c
        if kernels_serve(lafs0, lafs1, c.quality, c.prior, floats=(torch.float32,)):
            numbers = np.array((self.usual, self.radius, self.slope, MIN_AREA, MIN_PRIOR), np.float32)
            tensors = (lafs0, lafs1, c.quality, c.prior, c.mask)
            noise = torch.empty(c.mask.shape)
            for_each_pair(match_noise_kernel, tensors, numbers, out=noise, group=FramedMatches)
            return c.derived(noise=noise)
        return ungraphed(c, lambda: self._with_noise(c, lafs0, lafs1))

    def _with_noise(self, c: Correspondences, lafs0: Tensor, lafs1: Tensor) -> Correspondences:
        mask = c.mask & torch.isfinite(lafs0).flatten(2).all(2) & torch.isfinite(lafs1).flatten(2).all(2)
        for known in (c.quality, c.prior):
            mask = mask if known is None else mask & torch.isfinite(known)
        inside = mask[..., None, None]
        quality, prior = (None if known is None else torch.where(mask, known, 1) for known in (c.quality, c.prior))
        noise = match_noise(
            torch.where(inside, lafs0, 0), torch.where(inside, lafs1, 0), quality, prior,
            usual=self.usual, radius=self.radius, slope=self.slope,
        )  # fmt: skip
        return c.derived(noise=torch.where(mask, noise, 1))
