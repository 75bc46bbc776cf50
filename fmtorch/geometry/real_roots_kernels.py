"""Real roots of polynomials of degree ten, LANES samples at a time, compiled: signs on a grid, then Newton.

As in `five_point`: the projective line in two charts, in which buffers have the sample as their last axis.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.geometry.nullspace_kernels import LANES
from fmtorch.kernels import inner

Array = NDArray[Any]
KNOTS, POLISHING_STEPS = 33, 4  # of the grid in each of two charts; as in `five_point`
MOST = 10 * LANES  # roots of LANES polynomials


@inner
def real_roots(p: Array, count: int, valid: Array, lane: Array, chart: Array, z: Array) -> int:
    """Real roots of p (11, LANES) of `count` samples -> lane, chart, z (MOST,), in their order; how many there are.

    In chart 0 z is the root, in chart 1 its inverse.
    """
    size, values = np.zeros(LANES), np.empty((2 * KNOTS, LANES))
    ends, coefficients = np.empty((4, MOST)), np.empty((11, MOST))
    for d in range(11):
        for i in range(LANES):
            size[i] = max(size[i], abs(p[d, i]))
    for i in range(LANES):
        valid[i] &= size[i] > 0 and math.isfinite(size[i])
    for c in range(2):
        for k in range(KNOTS):
            o, x = c * KNOTS + k, _knot(c, k)
            for i in range(LANES):
                values[o, i] = p[10 * c, i]
            for d in range(1, 11):
                q = d if c == 0 else 10 - d
                for i in range(LANES):
                    values[o, i] = p[q, i] + values[o, i] * x
    found = 0
    for i in range(count):
        for c in range(2 if valid[i] else 0):
            for k in range(KNOTS - 1):
                low, high = values[c * KNOTS + k, i], values[c * KNOTS + k + 1, i]
                if (low < 0) != (high < 0) and found < MOST:
                    lane[found], chart[found] = i, c
                    ends[0, found], ends[1, found], ends[2, found], ends[3, found] = (
                        _knot(c, k),
                        _knot(c, k + 1),
                        low,
                        high,
                    )
                    for d in range(11):
                        coefficients[d, found] = p[d if c == 0 else 10 - d, i]
                    found += 1
    _polish(coefficients, ends, found, z)
    return found


@inner
def _knot(c: int, k: int) -> Any:
    """A place of the grid: from -1 to 1 in chart 0, back in chart 1."""
    return k / 16.0 - 1.0 if c == 0 else 1.0 - k / 16.0


@inner
def _polish(p: Array, ends: Array, count: int, z: Array) -> None:
    """Roots of polynomials (11, count) between places of different sign: Newton's method, or bisection -> z.

    ends: low, high, and the values there.
    """
    low, high, below, above = ends[0], ends[1], ends[2], ends[3]
    slope, value = np.empty(MOST), np.empty(MOST)
    for i in range(count):
        z[i] = low[i] - below[i] * (high[i] - low[i]) / (above[i] - below[i])
    for _ in range(POLISHING_STEPS):
        for i in range(count):
            slope[i], value[i] = p[0, i], p[1, i] + p[0, i] * z[i]
        for d in range(2, 11):
            c = p[d]
            for i in range(count):
                slope[i] = value[i] + slope[i] * z[i]
                value[i] = c[i] + value[i] * z[i]
        for i in range(count):
            same = (value[i] < 0) == (below[i] < 0)
            low[i], high[i] = z[i] if same else low[i], high[i] if same else z[i]
            x, a, b = z[i] - value[i] / slope[i], min(low[i], high[i]), max(low[i], high[i])
            z[i] = x if a <= x <= b else (low[i] + high[i]) / 2
