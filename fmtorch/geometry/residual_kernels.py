"""Squared residuals of matches under a model, as scores take them of many models, and fits of one.

A model family names its residual; scores, inliers and the stopping rule are written for any. Models have nine entries,
row by row, and act on points in normalised units.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.kernel import Inner, inner
from fmtorch.compiling.lanes import lanes, where

SINGLES = 16  # float32 numbers of a row
load, fill = lanes(SINGLES)
MATCH = 6  # rows of SINGLES matches: x0, y0, x1, y1, scale, weight
INFINITE, ZERO = np.float32(math.inf), np.float32(0)
TINY32, TINY = np.finfo(np.float32).tiny, float(np.finfo(np.float64).tiny)


class Residual(NamedTuple):
    """Three inner functions of one residual. name: unique, part of the names of the kernels that are made of it.

    of_row(f, rows, row): squared residuals of SINGLES matches, float32, times their scale. of_match(f, x0, y0, x1, y1):
    the square of one, in the type of its arguments. within(f, x0, y0, x1, y1, limit): whether that is within a limit.
    """

    name: str
    of_row: Inner[..., Any]
    of_match: Inner[..., Any]
    within: Inner[..., Any]


@inner
def _sampson(f: Array, x0: Any, y0: Any, x1: Any, y1: Any) -> tuple[Any, Any]:
    """The epipolar error, and the square of its slope."""
    a0, b0 = f[0] * x0 + f[1] * y0 + f[2], f[3] * x0 + f[4] * y0 + f[5]
    e = f[6] * x0 + f[7] * y0 + f[8] + a0 * x1 + b0 * y1
    a1, b1 = f[0] * x1 + f[3] * y1 + f[6], f[1] * x1 + f[4] * y1 + f[7]
    return e, a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1


@inner
def _sampson_of_row(f: Array, rows: Array, row: int) -> Any:
    e, slope = _sampson(f, load(rows, row), load(rows, row + 1), load(rows, row + 2), load(rows, row + 3))
    return e * e / where(slope > TINY32, slope, TINY32) * load(rows, row + 4)


@inner
def _sampson_of_match(f: Array, x0: Any, y0: Any, x1: Any, y1: Any) -> Any:
    e, slope = _sampson(f, x0, y0, x1, y1)
    return e * e / (slope if slope > TINY else TINY)


@inner
def _sampson_within(f: Array, x0: Any, y0: Any, x1: Any, y1: Any, limit: Any) -> Any:
    e, slope = _sampson(f, x0, y0, x1, y1)
    return e * e <= limit * slope


SAMPSON = Residual("sampson", _sampson_of_row, _sampson_of_match, _sampson_within)
"""The Sampson distance of a fundamental matrix (Hartley & Zisserman 2004, 11.4.3)."""


@inner
def _homography(h: Array, x: Any, y: Any, u: Any, v: Any) -> tuple[Any, Any, Any]:
    """Of a match W, positive before the horizon, and numerator and denominator of its squared distance."""
    w = h[6] * x + h[7] * y + h[8]
    e, f = h[0] * x + h[1] * y + h[2] - u * w, h[3] * x + h[4] * y + h[5] - v * w
    a, b, c, d = h[0] - u * h[6], h[1] - u * h[7], h[3] - v * h[6], h[4] - v * h[7]
    p, q, area, w2 = c * e - a * f, d * e - b * f, a * d - b * c, w * w
    return w, w2 * (e * e + f * f) + p * p + q * q, area * area + w2 * (a * a + b * b + c * c + d * d + w2)


@inner
def _homography_of_row(h: Array, rows: Array, row: int) -> Any:
    w, r2, by = _homography(h, load(rows, row), load(rows, row + 1), load(rows, row + 2), load(rows, row + 3))
    return where(w > ZERO, r2 / where(by > TINY32, by, TINY32) * load(rows, row + 4), INFINITE)


@inner
def _homography_of_match(h: Array, x: Any, y: Any, u: Any, v: Any) -> Any:
    w, r2, by = _homography(h, x, y, u, v)
    return r2 / by if w > 0 else w - w + math.inf


@inner
def _homography_within(h: Array, x: Any, y: Any, u: Any, v: Any, limit: Any) -> Any:
    return _homography_of_match(h, x, y, u, v) <= limit


HOMOGRAPHY = Residual("homography", _homography_of_row, _homography_of_match, _homography_within)
"""The Sampson distance of a homography (4.2.6); infinite behind its horizon (`homography_objective_kernels`)."""
