"""Which matches are inliers of a model, and whether a model may be taken for the best there is."""

import functools
import math
from typing import Protocol, runtime_checkable

import numpy as np

from fmtorch.estimators.models.fundamental import FitScale
from fmtorch.estimators.pair import Pair, squared
from fmtorch.estimators.sampling import Sampler
from fmtorch.geometry.arithmetic import logarithm_1p_kernel
from fmtorch.geometry.epipolar import SAMPSON, Residual
from fmtorch.jit.kernel import Array, F8x1, F8x2, I8x1, Kernel, kernel


@runtime_checkable
class InlierRule(Protocol):
    """Says which matches are inliers."""

    def __call__(self, squared_px: Array, pair: Pair) -> Array:
        """The inliers (n,) bool of a model with these squared Sampson distances (n,), px^2, float64."""
        ...


class WithinThreshold:
    """Inliers are the matches within the threshold (Sampson distance, px)."""

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold

    def __call__(self, squared_px: Array, pair: Pair) -> Array:
        return squared_px <= squared(self.threshold)


FLOOR_PX = 1e-3  # px, of robust deviations, as OpenCV's: those of exact matches are rounding


class BetterHalf:
    """Inliers are the matches at or below the median residual, as MATLAB's LMedS reports them, and the exact ones."""

    def __call__(self, squared_px: Array, pair: Pair) -> Array:
        return squared_px <= max(lower_median(squared_px), squared(FLOOR_PX))


class RobustDeviations:
    """Inliers lie within 2.5 robust standard deviations (Rousseeuw & Leroy 1987, chapter 5; Zhang 1998)."""

    PARAMETERS = 7

    def __call__(self, squared_px: Array, pair: Pair) -> Array:
        spare = max(pair.count - self.PARAMETERS, 1)
        sigma = 1.4826 * (1 + 5 / spare) * math.sqrt(lower_median(squared_px))
        return squared_px <= squared(max(2.5 * sigma, FLOOR_PX))


class StoppingRule:
    """Stop once an all-inlier sample was drawn with this probability (Fischler & Bolles 1981).

    threshold: up to which a match is an inlier, Sampson distance, px. sampler: its `weight` says how likely each match
    is to be drawn, relative to the others; without it all are equally likely."""

    def __init__(self, probability: float, threshold: float, sampler: Sampler) -> None:
        self.probability, self.threshold = probability, threshold
        self.weight = getattr(sampler, "weight", None)

    def __call__(self, F: Array, draws: int, pair: Pair, size: int) -> bool:
        """Whether the best model (9,), after so many draws of `size` matches, may be taken for the best there is."""
        weight = np.ones(pair.count, np.int64) if self.weight is None else self.weight(pair)
        share = share_within(residuals_squared_px(F.astype(np.float64), pair), squared(self.threshold), weight)
        all_inliers = share
        for _ in range(size - 1):  # a power would not have the same last bits everywhere
            all_inliers *= share
        missed: float = logarithm_1p_kernel(-min(all_inliers, 1 - 1e-12)) * draws
        return missed <= float(logarithm_1p_kernel(-self.probability))


def residuals_squared_px(F: Array, pair: Pair) -> Array:
    """Squared Sampson distances (n,) to a model (9,) in squared pixels of the photographs, float64."""
    out = np.empty(pair.count)
    residuals_squared_of(pair.residual)(F, pair.points, squared(pair.pixels_per_unit), out)
    return out if pair.stretch is None else out / np.square(pair.stretch)


def lower_median(values: Array) -> float:
    """The median (n,), of an even number the lower middle one."""
    rank = (len(values) + 1) // 2 - 1
    ordered = values.copy()
    ordered.partition(rank)
    return float(ordered[rank])


# The noise of a pair

MIN_INLIERS_FOR_NOISE = 15  # matches that tell the noise
MIN_PRIOR_FOR_NOISE = 0.3  # matches of a smaller prior do not tell the noise
USUAL_PX = 1.5  # Sampson distance within which right matches of usual noise lie
COARSE_SHARE = 0.2  # of the matches within a distance: that many between it and twice itself tell that it is too short


def coarse(r2: Array) -> bool:
    """Whether matches are coarser than usual, by their squared residuals (n,), px^2, of matches of usual noise: by how
    many lie between one and two of their usual distance (0.2: noise of 1.1 px), but for those that do by accident."""
    one, two, four, eight = (int(np.count_nonzero(r2 <= squared(k * USUAL_PX))) for k in (1, 2, 4, 8))
    return one >= MIN_INLIERS_FOR_NOISE and two - one - (eight - four) / 4 > COARSE_SHARE * one


def squared_in_noises(F: Array, pair: Pair) -> Array:
    """Squared residuals (n,) in squared pixels, of matches of usual noise."""
    r2 = residuals_squared_px(F, pair)
    if pair.noise is None:
        return r2
    return r2 / np.square(pair.noise if pair.stretch is None else pair.noise / pair.stretch)


def fit_distance(r2: Array, own: FitScale) -> float:
    """The scale of the loss in pixels, from the squared residuals of the inliers."""
    if len(r2) < MIN_INLIERS_FOR_NOISE:
        return own.default_px
    return min(
        max(own.scale_sigmas * own.sigmas_of_median * math.sqrt(lower_median(r2)), own.smallest_px), own.largest_px
    )


def noise_scale(r2: Array, pair: Pair, own: FitScale, within: float) -> float:
    """The scale of a loss in pixels by the noise of the likely matches within so many pixels of a model.
    r2: squared residuals (n,), of matches of usual noise, px^2."""
    return fit_distance(r2[(r2 <= squared(within)) & (pair.match_weight > MIN_PRIOR_FOR_NOISE)], own)


@functools.cache
def residuals_squared_of(residual: Residual) -> Kernel[..., None]:
    """The kernel of squared residuals for one model."""
    of_match = residual.of_match

    @kernel(holds_gil=True, name=f"residuals_squared_{residual.name}")
    def residuals_squared(F: F8x1, points: F8x2, factor: float, out: F8x1) -> None:
        """Squared residuals of points (4, n) under one model (9,), times a factor, in float64 -> out (n,)."""
        x0, y0, x1, y1 = points[0], points[1], points[2], points[3]
        f = (F[0], F[1], F[2], F[3], F[4], F[5], F[6], F[7], F[8])
        for i in range(len(out)):
            out[i] = of_match(f, x0[i], y0[i], x1[i], y1[i]) * factor

    return residuals_squared


@kernel(holds_gil=True)
def share_within(r2: F8x1, limit: float, weight: I8x1) -> float:
    """The share of the matches' weights (n,) of those whose squared residuals (n,) are within a limit."""
    total, within = np.int64(0), np.int64(0)
    for i in range(len(weight)):
        total += weight[i]
        within += weight[i] if r2[i] <= limit else 0
    return within / total


residuals_squared = residuals_squared_of(SAMPSON)
