"""How exact is each match? Noise from the keypoint's size, the distance ratio and the prior."""

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import gradient_wanted, sqrt
from fmtorch.jit.batches import for_each_pair
from fmtorch.jit.kernel import Array, F4x1, F4x3, F8x1, F8x3, inner, kernel

MIN_AREA = 1e-12  # square pixels: keeps the gradient of the scale finite
MIN_PRIOR = 0.02  # matches less likely than that are not taken for noisier


def match_noise(
    lafs0: Float[Tensor, "b n 2 3"],
    lafs1: Float[Tensor, "b n 2 3"],
    ratio: Float[Tensor, "b n"] | None = None,
    prior: Float[Tensor, "b n"] | None = None,
    mask: Bool[Tensor, "b n"] | None = None,
    *,
    usual: float,
    radius: float,
    slope: float,
) -> Float[Tensor, "b n"]:
    """Standard deviation of each match's distance to its epipolar line, in units of a usual match's.
    ``(1 + s / radius) (1 + slope ratio)^2 P^(-1/4) / usual`` with s the larger of the two frames' scales in pixels: a
    keypoint is located to a share of its size, and matches that are hard to tell apart, or that their neighbours
    contradict somewhat, are less exact. One where masked, and where a number is not finite. On the CPU."""
    single = lafs0.dtype == torch.float32
    numbers = np.array((usual, radius, slope, MIN_AREA, MIN_PRIOR), np.float32 if single else np.float64)
    tensors, out = (lafs0, lafs1, ratio, prior), torch.empty(lafs0.shape[:2], dtype=lafs0.dtype)
    noise = for_each_pair(_match_noise32 if single else _match_noise64, tensors, numbers, out=out, kind=out.dtype)
    if mask is not None:
        noise = torch.where(mask, noise, 1)
    if not gradient_wanted(lafs0, lafs1, ratio, prior):
        return noise
    mask = torch.ones_like(noise, dtype=torch.bool) if mask is None else mask
    for x in (lafs0, lafs1, ratio, prior):
        mask = mask if x is None else mask & torch.isfinite(x.reshape(*mask.shape, -1)).all(-1)
    (a, b, _, c, d, _), (e, f, _, g, h, _) = (
        torch.where(mask[..., None], lafs.flatten(2), 0).unbind(-1) for lafs in (lafs0, lafs1)
    )
    area = torch.maximum((a * d - b * c).abs(), (e * h - f * g).abs()).clamp_min(MIN_AREA)
    size = sqrt(area.detach())
    logarithm = area / (2 * size * (radius + size))  # its derivative, as those that follow: of the noise's logarithm
    if ratio is not None:
        ratio = torch.where(mask, ratio, 1)
        logarithm = logarithm + 2 * ratio * (slope / (1 + slope * ratio)).detach()
    if prior is not None:
        P = torch.where(mask, prior, 1).clamp_min(MIN_PRIOR)
        logarithm = logarithm - P / (4 * P.detach())
    return noise + torch.where(mask, noise, 0) * (logarithm - logarithm.detach())  # adds zeros


@kernel
def _match_noise32(lafs0: F4x3, lafs1: F4x3, ratio: F4x1, prior: F4x1, numbers: F4x1, out: F4x1) -> None:
    _noise_of_each(lafs0, lafs1, ratio, prior, numbers, out)


@kernel
def _match_noise64(lafs0: F8x3, lafs1: F8x3, ratio: F8x1, prior: F8x1, numbers: F8x1, out: F8x1) -> None:
    _noise_of_each(lafs0, lafs1, ratio, prior, numbers, out)


@inner
def _noise_of_each(lafs0: Array, lafs1: Array, ratio: Array, prior: Array, numbers: Array, out: Array) -> None:
    """`match_noise` of n matches -> out (n,). ratio, prior: (n,), empty where unknown.
    numbers: usual, radius in pixels, slope, least area in square pixels, least prior."""
    usual, radius, slope, min_area, min_prior = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    whole = out.dtype.type(1)
    for i in range(len(out)):
        size = max(_scale(lafs0, i, min_area), _scale(lafs1, i, min_area))
        noise = (whole + size / radius) / usual
        valid = _finite(lafs0, i) and _finite(lafs1, i)
        if len(ratio):
            valid = valid and math.isfinite(ratio[i])
            factor = whole + slope * ratio[i]
            noise *= factor * factor
        if len(prior):
            valid = valid and math.isfinite(prior[i])
            noise /= math.sqrt(math.sqrt(max(prior[i], min_prior)))
        out[i] = noise if valid else whole


@inner
def _scale(lafs: Array, i: int, min_area: Any) -> Any:
    """The square root of the area that frame i maps the unit square to, pixels."""
    return math.sqrt(max(abs(lafs[i, 0, 0] * lafs[i, 1, 1] - lafs[i, 0, 1] * lafs[i, 1, 0]), min_area))


@inner
def _finite(lafs: Array, i: int) -> bool:
    finite = True
    for row in range(2):
        for column in range(3):
            finite = finite and math.isfinite(lafs[i, row, column])
    return finite


@dataclasses.dataclass(frozen=True)
class MatchNoise:
    """Supplies ``noise`` by `match_noise`; matches without frames are left as they are.
    `Ransac` divides each match's residual by it, in its scores (but not that of the median) and in its non-linear fits;
    the 8-point algorithm, the `irls_*` estimators and other libraries do not look at it. Inliers are reported by their
    distance in pixels all the same. usual, radius, slope: see `match_noise`."""

    usual: float
    radius: float
    slope: float

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches with their noise; one where masked or where it cannot be told."""
        lafs0, lafs1 = c.lafs0, c.lafs1
        if lafs0 is None or lafs1 is None:
            return c
        numbers = {"usual": self.usual, "radius": self.radius, "slope": self.slope}
        return c.derived(noise=match_noise(lafs0, lafs1, c.ambiguity, c.prior, c.mask, **numbers))
