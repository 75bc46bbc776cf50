"""`inliers` on the arrays of one pair: rules that tell inliers, and the rule that stops a search."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import numpy as np

from fmtorch.estimators import inliers
from fmtorch.estimators.one_pair.pair import Array, OnePair, squared
from fmtorch.estimators.one_pair.sampling import Sampler
from fmtorch.estimators.pool_kernels import residuals_squared, share_within, within
from fmtorch.geometry.arithmetic_kernels import logarithm_1p


def residuals_squared_px(F: Array, pair: OnePair) -> Array:
    """Squared Sampson distances (n,) to a model of nine entries in squared pixels, float64."""
    out = np.empty(pair.count)
    residuals_squared(F.astype(np.float64, copy=False).ravel(), pair.points, squared(pair.pixels_per_unit), out)
    return out


def within_px(F: Array, pair: OnePair, threshold: float) -> Array:
    """The matches (n,) whose Sampson distance to a model of nine entries is within a threshold in pixels."""
    out = np.empty(pair.count, np.bool_)
    within(
        F.astype(np.float64, copy=False).ravel(), pair.points, squared(pair.pixels_per_unit), squared(threshold), out
    )
    return out


def median_of_matches(r2: Array) -> float:
    """The (lower) median."""
    rank = (len(r2) + 1) // 2 - 1
    ordered = r2.copy()
    ordered.partition(rank)
    return float(ordered[rank])


@runtime_checkable
class InlierRule(Protocol):
    """As `inliers.InlierRule`."""

    def __call__(self, F: Array, pair: OnePair) -> Array:
        """The inliers (n,) of a model (3, 3)."""
        ...


class WithinThreshold:
    """As `inliers.WithinThreshold`."""

    def __init__(self, part: inliers.WithinThreshold) -> None:
        self.part = part

    def __call__(self, F: Array, pair: OnePair) -> Array:
        """As `InlierRule`."""
        return within_px(F, pair, self.part.threshold)


class BetterHalf:
    """As `inliers.BetterHalf`."""

    def __init__(self, part: inliers.BetterHalf) -> None:
        pass

    def __call__(self, F: Array, pair: OnePair) -> Array:
        """As `InlierRule`."""
        r2 = residuals_squared_px(F, pair)
        better: Array = r2 <= median_of_matches(r2)
        return better


class RobustDeviations:
    """As `inliers.RobustDeviations`."""

    def __init__(self, part: inliers.RobustDeviations) -> None:
        self.part = part

    def __call__(self, F: Array, pair: OnePair) -> Array:
        """As `InlierRule`."""
        r2 = residuals_squared_px(F, pair)
        spare = max(pair.count - self.part.PARAMETERS, 1)
        sigma = 1.4826 * (1 + 5 / spare) * math.sqrt(median_of_matches(r2))
        inside: Array = r2 <= squared(2.5 * sigma)
        return inside


class Confidence:
    """As `inliers.Confidence`."""

    def __init__(self, part: inliers.Confidence, sampler: Sampler) -> None:
        self.part, self.sampler = part, sampler

    def __call__(self, F: Array, draws: int, pair: OnePair, size: int) -> list[bool]:
        """Whether the best model (9,), after so many draws of `size` matches, may be taken for the best there is."""
        factor, limit = squared(pair.pixels_per_unit), squared(self.part.threshold)
        share = share_within(F.astype(np.float64), pair.points, factor, limit, self.sampler.weight(pair))
        all_inliers = share
        for _ in range(size - 1):
            all_inliers *= share
        missed = logarithm_1p(-min(all_inliers, 1 - 1e-12)) * draws
        return [missed <= logarithm_1p(-self.part.probability)]
