"""Real roots of a cubic in closed form, without transcendental functions, polished by Newton's method."""

import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.jit.kernel import Array, inner, matrix
from fmtorch.jit.lanes import LANES, absolute, any_lane, fill, load, store, where

NEGLIGIBLE = 1e-60  # relative to the largest coefficient: counts as zero, so that no power over- or underflows
SEPARATION = 1e-4  # relative to the outermost root: the others are found as those of the quadratic that remains
CUBIC_POLISHING_STEPS = 2  # the closed form is good to 1e-8, the quadratic to 1e-4, and Newton's method squares that


@inner
def cubic_roots(c: Array, roots: Array, valid: Array) -> None:
    """The real roots of c[0] z^3 + c[1] z^2 + c[2] z + c[3] -> roots (3,), valid (3,). c is scaled in place.
    Three real roots by Viete's substitution (its extreme root by Newton's method instead of a cosine), one by Cardano's
    formula; both are arranged against cancellation. Leading coefficients may vanish (a quadratic, a line); multiple
    roots fill as many slots. A polynomial that is zero or not finite has none."""
    scale, finite = 0.0, True
    for k in range(4):
        scale, finite = max(scale, abs(c[k])), finite and math.isfinite(c[k])
    for k in range(3):
        valid[k] = False
    if not (scale > 0 and finite):
        return
    for k in range(4):
        c[k] /= scale
        if abs(c[k]) < NEGLIGIBLE:
            c[k] = 0.0
    a, b, d = c[0], c[1], c[3]
    # One root far outside the other two would swamp them in the shift by b / 3a.
    apart = abs(a * c[2]) <= SEPARATION * b * b and a * a * abs(d) <= SEPARATION**2 * (b * b * abs(b)) and b != 0
    if a == 0 or apart:
        _quadratic(b, c[2], d, roots, valid)
        valid[2] = a != 0
        roots[2] = -b / a if a != 0 else 0.0
    else:
        _depressed(a, b, c[2], d, roots, valid)
    for k in range(3):
        z = roots[k]
        for _ in range(CUBIC_POLISHING_STEPS if valid[k] else 0):
            f = ((a * z + b) * z + c[2]) * z + d
            slope = (3 * a * z + 2 * b) * z + c[2]
            better = z - f / (slope if slope != 0 else 1.0)
            if abs(((a * better + b) * better + c[2]) * better + d) < abs(f):
                z = better
        roots[k] = z


@inner
def _depressed(a: float, b: float, c: float, d: float, roots: Array, valid: Array) -> None:
    """Roots through t^3 + 3 P t + 2 Q = 0 with z = t - b / 3a."""
    shift = b / (3 * a)
    P = c / (3 * a) - shift * shift
    Q = shift * shift * shift - shift * c / (2 * a) + d / (2 * a)
    discriminant = Q * Q + P * P * P
    sign = 1.0 if Q < 0 else -1.0
    valid[0] = True
    if discriminant <= 0:  # t = m y, y^3 - 3 y = 2 r with r in [0, 1] and the extreme root y in [sqrt 3, 2]
        m = math.sqrt(max(-P, 0.0))
        m3 = m * m * m
        r = min(abs(Q) / m3, 1.0) if m3 > 0 else 0.0
        y = 2.0
        for _ in range(5):  # quadratic from an error of at most 0.27
            y = (2 * y * y * y + 2 * r) / (3 * (y * y - 1))
        y1 = -(y + math.sqrt(3 * max(2 - y, 0.0) * (2 + y))) / 2
        roots[0], roots[1], roots[2] = y * sign * m - shift, y1 * sign * m - shift, 2 * r / (y * y1) * sign * m - shift
        valid[1], valid[2] = True, True
        return
    u = _cube_root(abs(Q) + math.sqrt(discriminant))
    v = P / u
    roots[0] = (u - v if P < 0 else 2 * abs(Q) / (u * u + P + v * v)) * sign - shift


@inner
def _quadratic(a: float, b: float, c: float, roots: Array, valid: Array) -> None:
    """Roots of a z^2 + b z + c, of which a, or a and b, may be zero."""
    discriminant = b * b - 4 * a * c
    real = discriminant >= 0
    w = -(b + math.copysign(math.sqrt(discriminant) if real else 0.0, b)) / 2
    roots[0], roots[1] = 0.0 if w == 0 else c / w, 0.0 if a == 0 else w / a
    valid[0], valid[1] = real and (w != 0 or a != 0), real and a != 0


@inner
def _cube_root(x: float) -> Any:
    """The real cube root of a positive number, to the last digits: Halley's method from a third of the exponent."""
    # A third of the bits of x is a cube root to 6 %; the constant makes up for two thirds of the exponent's bias.
    y = np.int64(np.float64(x).view(np.int64) // 3 + 0x2A9F7893782DA1CE).view(np.float64)
    for _ in range(3):  # cubic convergence: 6e-2, 1e-4, 1e-12, 1e-36
        y3 = y * y * y
        y = y * ((y3 + 2 * x) / (2 * y3 + x))
    return y


# Real roots of polynomials of degree ten, LANES samples at a time, compiled: signs on a grid, then Newton

KNOTS, POLISHING_STEPS = 33, 4  # of the grid in each of two charts; of Newton's method, from the secant
DEGREE = 10


class Roots(NamedTuple):
    """Of LANES polynomials, their first roots in rows 0, their second in rows 1, ... (DEGREE, LANES).
    far: whether in the second chart, in which z is the inverse of the root. exists: whether there is one.
    low, high, below, above: places of different sign around it, and the values there."""

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
    valid: a mask; of other polynomials there are none."""
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
