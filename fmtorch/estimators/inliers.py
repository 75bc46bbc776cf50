"""Which matches are inliers of a model, and whether a model may be taken for the best there is."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.sampling import Sampler
from fmtorch.estimators.scores import median_rank
from fmtorch.geometry import arithmetic_kernels
from fmtorch.geometry.arithmetic import logarithm_1p, sqrt
from fmtorch.geometry.residuals import sampson_squared


def residuals_squared_px(F: Float[Tensor, "p 3 3"], pairs: NormalizedPairs) -> Float[Tensor, "p n"]:
    """Squared Sampson distances in squared pixels, float64."""
    r2 = sampson_squared(F.flatten(1).T[..., None].contiguous(), pairs.points)[:, 0]
    return r2 * pairs.pixels_per_unit.square()[:, None]


def median_of_matches(r2: Float[Tensor, "p n"], pairs: NormalizedPairs) -> Float[Tensor, "p 1"]:
    """The (lower) median over the matches of each pair."""
    ordered = torch.where(pairs.mask, r2, torch.inf).sort(1).values
    return ordered.gather(1, median_rank(pairs.count)[:, None] - 1)


@runtime_checkable
class InlierRule(Protocol):
    """Tells inliers from outliers."""

    def __call__(self, F: Float[Tensor, "p 3 3"], pairs: NormalizedPairs) -> Bool[Tensor, "p n"]:
        """The inliers of each pair's model."""
        ...


class WithinThreshold:
    """Inliers are the matches within the threshold (Sampson distance, px)."""

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold

    def __call__(self, F: Float[Tensor, "p 3 3"], pairs: NormalizedPairs) -> Bool[Tensor, "p n"]:
        """As `InlierRule`."""
        return (residuals_squared_px(F, pairs) <= self.threshold**2) & pairs.mask


class BetterHalf:
    """Inliers are the matches at or below the median residual, as MATLAB's LMedS reports them."""

    def __call__(self, F: Float[Tensor, "p 3 3"], pairs: NormalizedPairs) -> Bool[Tensor, "p n"]:
        """As `InlierRule`."""
        r2 = residuals_squared_px(F, pairs)
        return (r2 <= median_of_matches(r2, pairs)) & pairs.mask


class RobustDeviations:
    """Inliers lie within 2.5 robust standard deviations (Rousseeuw & Leroy 1987, chapter 5; Zhang 1998)."""

    PARAMETERS = 7

    def __call__(self, F: Float[Tensor, "p 3 3"], pairs: NormalizedPairs) -> Bool[Tensor, "p n"]:
        """As `InlierRule`."""
        r2 = residuals_squared_px(F, pairs)
        spare = (pairs.count - self.PARAMETERS).clamp_min(1)[:, None]
        sigma = 1.4826 * (1 + 5 / spare) * sqrt(median_of_matches(r2, pairs))
        return (r2 <= (2.5 * sigma).square()) & pairs.mask


class Confidence:
    """The stopping rule: an all-inlier sample was drawn with this probability (Fischler & Bolles 1981).

    threshold: up to which a match is an inlier, Sampson distance, px. sampler: how likely each match is to be drawn.
    """

    def __init__(self, probability: float, threshold: float, sampler: Sampler) -> None:
        self.probability, self.threshold, self.sampler = probability, threshold, sampler

    def __call__(
        self, F: Float[Tensor, "9 p"], draws: Int[Tensor, " p"], pairs: NormalizedPairs, size: int
    ) -> list[bool]:
        """Whether the best model of each pair may be taken for the best there is. size: of the samples drawn."""
        r2 = sampson_squared(F[..., None].contiguous(), pairs.points.to(F.dtype))[:, 0]
        support = r2 <= (self.threshold / pairs.pixels_per_unit).square().to(r2.dtype)[:, None]
        weight = self.sampler.weight(pairs)
        share = torch.where(support, weight, 0).sum(1).to(torch.float64) / weight.sum(1)
        all_inliers = share
        for _ in range(size - 1):  # a power would not have the same last bits everywhere
            all_inliers = all_inliers * share
        missed = logarithm_1p(-all_inliers.clamp(max=1 - 1e-12)) * draws
        confident: list[bool] = (missed <= arithmetic_kernels.logarithm_1p(-self.probability)).tolist()
        return confident
