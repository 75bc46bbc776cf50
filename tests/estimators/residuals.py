"""Sampson distances with bounds: between which they are when computed in float32."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array
from fmtorch.estimators.pair import Pair
from tests.reference.ransac import sampson

ROUNDING = 2.0**-24  # of a float32, relative
SUMS, ROW = 8, 3  # roundings of a term of x1' F x0, and of one of F x0 or F' x1
LAST = 1 + 16 * ROUNDING  # roundings of squares, their sum, a quotient and a product


class Residuals(NamedTuple):
    """Of n matches under one model: as they are, and bounds of what float32 makes of them."""

    exact: Array
    low: Array
    high: Array


def residuals(F: Array, pair: Pair, threshold: float) -> Residuals:
    """Sampson distances in thresholds (n,) to a model (9,) of float32 numbers, each match's threshold by its noise."""
    points, A = pair.points32.astype(np.float64), F.astype(np.float32).astype(np.float64).reshape(3, 3)
    scale = pair.pixels_per_noise / threshold
    exact = np.array([sampson(A, x[:2], x[2:]) for x in points.T])
    h0, h1 = np.vstack([points[:2], np.ones(pair.count)]), np.vstack([points[2:], np.ones(pair.count)])
    error = np.abs((h1 * (A @ h0)).sum(0))
    slope = np.sqrt(((A @ h0)[:2] ** 2).sum(0) + ((A.T @ h1)[:2] ** 2).sum(0))
    terms = (np.abs(h1) * (np.abs(A) @ np.abs(h0))).sum(0)
    rows = np.sqrt(((np.abs(A) @ np.abs(h0))[:2] ** 2).sum(0) + ((np.abs(A).T @ np.abs(h1))[:2] ** 2).sum(0))
    off, slope_off = SUMS * ROUNDING * terms, ROW * ROUNDING * rows
    low = np.maximum(error - off, 0) / (slope + slope_off) / LAST
    high = np.where(slope > slope_off, (error + off) / np.maximum(slope - slope_off, 1e-300) * LAST, np.inf)
    return Residuals(exact * scale, low * scale, high * scale)
