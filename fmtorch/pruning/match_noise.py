"""How exact is each match? Noise from the keypoint's size, the distance ratio and the prior."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.records import ungraphed
from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import sqrt

MIN_AREA = 1e-12  # square pixels: keeps the gradient of the scale finite
MIN_PRIOR = 0.02  # matches less likely than that are not taken for noisier


def match_noise(
    lafs0: Float[Tensor, "b n 2 3"],
    lafs1: Float[Tensor, "b n 2 3"],
    ratio: Float[Tensor, "b n"] | None = None,
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
    if ratio is not None:
        noise = noise * (1 + slope * ratio).square()
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
        return ungraphed(c, lambda: self._with_noise(c, lafs0, lafs1))

    def _with_noise(self, c: Correspondences, lafs0: Tensor, lafs1: Tensor) -> Correspondences:
        mask = c.mask & torch.isfinite(lafs0).flatten(2).all(2) & torch.isfinite(lafs1).flatten(2).all(2)
        for known in (c.ambiguity, c.prior):
            mask = mask if known is None else mask & torch.isfinite(known)
        inside = mask[..., None, None]
        ratio, prior = (None if known is None else torch.where(mask, known, 1) for known in (c.ambiguity, c.prior))
        noise = match_noise(
            torch.where(inside, lafs0, 0), torch.where(inside, lafs1, 0), ratio, prior,
            usual=self.usual, radius=self.radius, slope=self.slope,
        )  # fmt: skip
        return c.derived(noise=torch.where(mask, noise, 1))
