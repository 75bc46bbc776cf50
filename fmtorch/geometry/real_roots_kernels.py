"""Real roots of polynomials of degree ten, LANES samples at a time, compiled: signs on a grid, then Newton.

The projective line in two charts; two roots within one interval of the grid are not found, a tenth of all roots of the
five-point algorithm. Buffers are rows of LANES numbers, one a sample.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.kernel import inner
from fmtorch.compiling.lanes import LANES, absolute, any_lane, fill, load, store, where
from fmtorch.compiling.scratch import matrix

KNOTS, POLISHING_STEPS = 33, 4  # of the grid in each of two charts; of Newton's method, from the secant
DEGREE = 10


class Roots(NamedTuple):
    """Of LANES polynomials, their first roots in rows 0, their second in rows 1, ... (DEGREE, LANES).

    far: whether in the second chart, in which z is the inverse of the root. exists: whether there is one.
    low, high, below, above: places of different sign around it, and the values there.
    """

    z: Array
    far: Array
    exists: Array
    low: Array
    high: Array
    below: Array
    above: Array


@inner
def room_for_roots() -> Any:
    """Buffers for `real_roots`."""
    z, far, exists = matrix(DEGREE, LANES), np.empty((DEGREE, LANES), np.bool_), np.empty((DEGREE, LANES), np.bool_)
    low, high = matrix(DEGREE, LANES), matrix(DEGREE, LANES)
    return Roots(z, far, exists, low, high, matrix(DEGREE, LANES), matrix(DEGREE, LANES))


@inner
def real_roots(p: Array, valid: Any, roots: Any) -> int:
    """Real roots of p (DEGREE + 1, LANES), highest power first, in their order -> roots; how many rows of them.

    valid: a mask; of other polynomials there are none.
    """
    size, most = fill(0.0), 0
    for d in range(DEGREE + 1):
        magnitude = absolute(load(p, d))
        size = where(magnitude <= size, size, magnitude)
    valid = valid & (size > 0.0) & (size < math.inf)
    values, change, number = matrix(KNOTS, LANES), np.empty((1, LANES), np.bool_), np.zeros(LANES, np.int64)
    for s in range(DEGREE):
        store(roots.exists, s, size != size)
        store(roots.far, s, size != size)
        store(roots.low, s, fill(0.0))
        store(roots.high, s, fill(1.0))
        store(roots.below, s, fill(-1.0))
        store(roots.above, s, fill(1.0))
    for chart in range(2):
        for k in range(KNOTS):
            store(values, k, _value(p, chart == 1, _knot(chart, k)))
        for k in range(KNOTS - 1):
            changes = valid & ((load(values, k) < 0.0) ^ (load(values, k + 1) < 0.0))
            if not any_lane(changes):
                continue
            store(change, 0, changes)
            for i in range(LANES):
                s = number[i]
                if change[0, i] and s < DEGREE:
                    roots.exists[s, i], roots.far[s, i] = True, chart == 1
                    roots.low[s, i], roots.high[s, i] = _knot(chart, k), _knot(chart, k + 1)
                    roots.below[s, i], roots.above[s, i] = values[k, i], values[k + 1, i]
                    number[i] = s + 1
                    most = max(most, s + 1)
    coefficients = matrix(DEGREE + 1, LANES)
    for s in range(most):
        _polish(p, s, roots, coefficients)
    return most


@inner
def _knot(chart: int, k: int) -> Any:
    """A place of the grid: from -1 to 1 in chart 0, back in chart 1."""
    return k / 16.0 - 1.0 if chart == 0 else 1.0 - k / 16.0


@inner
def _value(p: Array, far: bool, x: float) -> Any:
    """The polynomials, of which the second chart has the coefficients in the other order, at a place."""
    value = load(p, DEGREE if far else 0)
    for d in range(1, DEGREE + 1):
        value = load(p, DEGREE - d if far else d) + value * x
    return value


@inner
def _polish(p: Array, s: int, roots: Any, c: Array) -> None:
    """A row of roots between places of different sign: Newton's method, or bisection -> z."""
    far, low, high = load(roots.far, s), load(roots.low, s), load(roots.high, s)
    below, above = load(roots.below, s), load(roots.above, s)
    for d in range(DEGREE + 1):
        store(c, d, where(far, load(p, DEGREE - d), load(p, d)))
    z = low - below * (high - low) / (above - below)
    for _ in range(POLISHING_STEPS):
        slope, value = load(c, 0), load(c, 1) + load(c, 0) * z
        for d in range(2, DEGREE + 1):
            slope = value + slope * z
            value = load(c, d) + value * z
        crossed = (value < 0.0) ^ (below < 0.0)
        low, high = where(crossed, low, z), where(crossed, z, high)
        x, a, b = z - value / slope, where(low < high, low, high), where(low < high, high, low)
        z = where((a <= x) & (x <= b), x, (low + high) / 2.0)
    store(roots.z, s, z)
