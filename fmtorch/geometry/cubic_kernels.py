"""`cubic` for one polynomial, compiled: the same closed form."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner

Array = NDArray[Any]
NEGLIGIBLE, SEPARATION, POLISHING_STEPS = 1e-60, 1e-4, 2  # as in `cubic`


@inner
def cubic_roots(c: Array, roots: Array, valid: Array) -> None:
    """The real roots of c[0] z^3 + c[1] z^2 + c[2] z + c[3] -> roots (3,), valid (3,). c is scaled in place."""
    scale = max(max(abs(c[0]), abs(c[1])), max(abs(c[2]), abs(c[3])))
    for k in range(3):
        valid[k] = False
    if not (scale > 0 and math.isfinite(scale)):
        return
    for k in range(4):
        c[k] /= scale
        if abs(c[k]) < NEGLIGIBLE:
            c[k] = 0.0
    a, b, d = c[0], c[1], c[3]
    apart = abs(a * c[2]) <= SEPARATION * b * b and a * a * abs(d) <= SEPARATION**2 * (b * b * abs(b)) and b != 0
    if a == 0 or apart:
        _quadratic(b, c[2], d, roots, valid)
        valid[2] = a != 0
        roots[2] = -b / a if a != 0 else 0.0
    else:
        _depressed(a, b, c[2], d, roots, valid)
    for k in range(3):
        z = roots[k]
        for _ in range(POLISHING_STEPS if valid[k] else 0):
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
    if discriminant <= 0:
        m = math.sqrt(max(-P, 0.0))
        m3 = m * m * m
        r = min(abs(Q) / m3, 1.0) if m3 > 0 else 0.0
        y = 2.0
        for _ in range(5):
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
    """`cubic.cube_root`, the same bits: Halley's method from a third of the exponent."""
    y = np.int64(np.float64(x).view(np.int64) // 3 + 0x2A9F7893782DA1CE).view(np.float64)
    for _ in range(3):
        y3 = y * y * y
        y = y * ((y3 + 2 * x) / (2 * y3 + x))
    return y
