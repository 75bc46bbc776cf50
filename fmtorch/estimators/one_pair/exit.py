"""From the outcome of one pair to its estimate in pixels, if its inliers support one. As `estimators.batching`."""

from __future__ import annotations

import numpy as np

from fmtorch.estimators import pairs_kernels as compiled
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.support import FIRST_LOOK, reason
from fmtorch.estimators.support_kernels import support


def lack_of_support(points: Array, inliers: Array, minimal: int, rounding: float) -> str:
    """As `support.lack_of_support`, of points (4, n) and inliers (n,)."""
    lack, n = _lack(points, inliers, FIRST_LOOK, minimal, rounding), len(inliers)
    return _lack(points, inliers, n, minimal, rounding) if lack and n > FIRST_LOOK else lack


def _lack(points: Array, inliers: Array, first: int, minimal: int, rounding: float) -> str:
    on_line = np.empty(2, np.bool_)
    different = support(points, inliers, min(first, len(inliers)), minimal, rounding, on_line)
    return reason(different, on_line.tolist(), minimal)


def rounding_of(pair: OnePair, relative: float) -> float:
    """How exact the coordinates of a pair are, in the unit of its points; relative: of a number of 1."""
    largest: float = max(map(abs, pair.centre.tolist()))
    return (largest / pair.pixels_per_unit + 1) * relative


def to_pixels(F: Array, pair: OnePair) -> Array | None:
    """As `NormalizedPairs.to_pixels`, of one matrix; None where that is not finite."""
    F, out = np.ascontiguousarray(F, np.float64), np.empty((3, 3))
    return out if compiled.to_pixels(F, pair.centre, pair.pixels_per_unit, out) else None
