"""On which side of both cameras matches lie: of the candidates of one pair."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fmtorch.compiling.arrays import Array, F8x1, F8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.lanes import absolute, added, fill, load, sqrt, where
from fmtorch.estimators.families.cameras import Cameras
from fmtorch.geometry.arithmetic_kernels import exponential
from fmtorch.geometry.sampson_objective_kernels import MATCH, Weighted, in_rows

BITS = 20  # fractional, of the support, so that its sums are exact
REST = 1 / 26  # of the gain of Geman & McClure at 5 scales, from which on it is zero
TINY = float(np.finfo(np.float64).tiny)


@kernel(holds_gil=True)
def cheirality(cameras: Cameras, longest: F8x1, F: F8x2, matches: Weighted, tolerance: float, out: F8x1) -> None:
    """The share of the support that lies in front of both cameras, for the better of their poses -> out (k,).

    Support is each match's weight times the gain of Geman & McClure; matches of rays that are parallel up to the
    tolerance, in the unit of the points, lie on either side. longest: (2,), the longer sides of the images. F: (k, 9),
    the cameras' models. matches: from the principal points; their s2 is *one over* the square of each one's scale.
    """
    axes, focal = cameras.axes, cameras.focal
    rows, shift = in_rows(matches.points, matches.weight, matches.s2), 1.5 * 2.0 ** (52 - BITS)
    for k in range(len(out)):
        U, V, f = axes[k, 0], axes[k, 1], F[k]
        handed = 1.0 if (_determinant(U) > 0) == (_determinant(V) > 0) else -1.0
        d0, d1 = exponential(focal[k, 0]) * longest[0], exponential(focal[k, 1]) * longest[1]
        total, front = fill(0.0), fill(0.0)
        back, mirrored, both = front, front, front
        for row in range(0, len(rows), MATCH):
            x0, y0, x1, y1 = load(rows, row), load(rows, row + 1), load(rows, row + 2), load(rows, row + 3)
            support = _gain(f, x0, y0, x1, y1, load(rows, row + 5)) * load(rows, row + 4) + shift - shift
            total += support
            a1, b1 = _ray(V, 0, x0, y0, d0), _ray(U, 0, x1, y1, d1)
            a2, b2 = _ray(V, 1, x0, y0, d0), _ray(U, 1, x1, y1, d1)
            a3, b3 = _ray(V, 2, x0, y0, d0), _ray(U, 2, x1, y1, d1)
            a, b, side = a1 * a1 + a2 * a2, b1 * b1 + b2 * b2, a1 * b2 - a2 * b1
            distance = b3 * absolute(side) - handed * a3 * b
            parallel = sqrt(b * (b + b3 * b3) * (a + a3 * a3)) * (tolerance / d1)
            ahead, behind = distance > -parallel, -distance > -parallel
            front += where(ahead & (side > 0.0), support, 0.0)
            back += where(behind & (side > 0.0), support, 0.0)
            mirrored += where(ahead & (side < 0.0), support, 0.0)
            both += where(behind & (side < 0.0), support, 0.0)
        largest, total_support = max(max(added(front), added(back)), max(added(mirrored), added(both))), added(total)
        out[k] = largest / total_support if total_support > 0 else math.nan


@inner
def _gain(f: Array, x0: Any, y0: Any, x1: Any, y1: Any, scale: Any) -> Any:
    """The gains of matches."""
    a0, b0 = f[0] * x0 + f[1] * y0 + f[2], f[3] * x0 + f[4] * y0 + f[5]
    a1, b1 = f[0] * x1 + f[3] * y1 + f[6], f[1] * x1 + f[4] * y1 + f[7]
    e = f[6] * x0 + f[7] * y0 + f[8] + a0 * x1 + b0 * y1
    slope = a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1
    gain = 1.0 / (1.0 + e * e / where(slope > TINY, slope, TINY) * scale) - REST
    return where(gain > 0.0, gain, 0.0) * (1 / (1 - REST))


@inner
def _ray(M: Array, axis: int, x: Any, y: Any, depth: float) -> Any:
    """A component of points' rays in the axes of a camera."""
    return M[2, axis] + M[0, axis] / depth * x + M[1, axis] / depth * y


@inner
def _determinant(M: Array) -> Any:
    a = M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
    return a + M[0, 1] * (M[1, 2] * M[2, 0] - M[1, 0] * M[2, 2]) + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
