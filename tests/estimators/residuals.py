"""Sampson distances with bounds: between which they are when computed in float32, or in float64."""

from typing import NamedTuple

import numpy as np

from fmtorch.estimators import Pair
from fmtorch.jit.kernel import Array
from tests.reference.solvers import sampson

SUMS, ROW, LAST = 8, 3, 16
"""Roundings of a term of x1' F x0; of one of F x0 or F' x1; of squares, their sum, a quotient and a product."""


class Residuals(NamedTuple):
    """Of n matches under one model: as they are, and bounds of what rounding makes of them."""

    exact: Array
    low: Array
    high: Array


def residuals(F: Array, pair: Pair, threshold: float, dtype: type[np.floating] = np.float32) -> Residuals:
    """Sampson distances in thresholds (n,) to a model (9,), each match's threshold by its noise.

    dtype: of points and model, and in which the bounds allow to compute.
    """
    points, A = (x.astype(dtype).astype(np.float64) for x in (pair.points, F.reshape(3, 3)))
    scale = pair.pixels_per_noise / threshold
    rounding = np.finfo(dtype).eps / (2 if dtype is np.float32 else 1)  # in float64 what is exact is rounded, too
    exact = np.array([sampson(A, x[:2], x[2:]) for x in points.T])
    h0, h1 = np.vstack([points[:2], np.ones(pair.count)]), np.vstack([points[2:], np.ones(pair.count)])
    error = np.abs((h1 * (A @ h0)).sum(0))
    slope = np.sqrt(((A @ h0)[:2] ** 2).sum(0) + ((A.T @ h1)[:2] ** 2).sum(0))
    terms = (np.abs(h1) * (np.abs(A) @ np.abs(h0))).sum(0)
    rows = np.sqrt(((np.abs(A) @ np.abs(h0))[:2] ** 2).sum(0) + ((np.abs(A).T @ np.abs(h1))[:2] ** 2).sum(0))
    last = 1 + LAST * rounding
    off, slope_off = SUMS * rounding * terms, ROW * rounding * rows
    low = np.maximum(error - off, 0) / (slope + slope_off) / last
    high = np.where(slope > slope_off, (error + off) / np.maximum(slope - slope_off, 1e-300) * last, np.inf)
    return Residuals(exact * scale, low * scale, high * scale)
