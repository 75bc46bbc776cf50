"""`cheirality` for the candidates of one pair, compiled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.geometry.arithmetic_kernels import exponential
from fmtorch.kernels import inner, kernel

Array = NDArray[Any]
BITS = 20  # fractional, of the support, so that its sums are exact
REST = 1 / 26  # of the gain of Geman & McClure, as in `scores`
TINY = float(np.finfo(np.float64).tiny)


@kernel("f8[:, :, :, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8, f8[::1]", brief=True)
def share_in_front(
    axes: Array, focal: Array, longest: Array, F: Array, points: Array, prior: Array, scale: Array, tolerance: float,
    out: Array,
) -> None:  # fmt: skip
    """`cheirality.share_in_front` of candidates -> out (k,). Support is prior times the gain of Geman & McClure.

    axes: (k, 2, 3, 3), U and V. focal: (k, 2), logarithms of focal lengths in units of the longer sides (2,), which are
    in the unit of the points. F: (k, 9), their models. points: (4, n), from the principal points. prior, scale: (n,),
    the latter one over the square of each match's scale. tolerance: in the unit of the points.
    """
    for k in range(len(out)):
        U, V, f = axes[k, 0], axes[k, 1], F[k]
        handed = 1.0 if (_determinant(U) > 0) == (_determinant(V) > 0) else -1.0
        d0, d1 = exponential(focal[k, 0]) * longest[0], exponential(focal[k, 1]) * longest[1]
        total, fronts = np.int64(0), np.zeros(4, np.int64)
        for i in range(points.shape[1]):
            x0, y0, x1, y1 = points[0, i], points[1, i], points[2, i], points[3, i]
            support = _support(f, x0, y0, x1, y1, scale[i], prior[i])
            total += support
            a1, b1 = _ray(V, 0, x0, y0, d0), _ray(U, 0, x1, y1, d1)
            a2, b2 = _ray(V, 1, x0, y0, d0), _ray(U, 1, x1, y1, d1)
            a3, b3 = _ray(V, 2, x0, y0, d0), _ray(U, 2, x1, y1, d1)
            a, b, side = a1 * a1 + a2 * a2, b1 * b1 + b2 * b2, a1 * b2 - a2 * b1
            distance = b3 * abs(side) - handed * a3 * b
            parallel = math.sqrt(b * (b + b3 * b3) * (a + a3 * a3)) * (tolerance / d1)
            ahead, behind = support * (distance > -parallel), support * (-distance > -parallel)
            fronts[0] += ahead * (side > 0)
            fronts[1] += behind * (side > 0)
            fronts[2] += ahead * (-side > 0)
            fronts[3] += behind * (-side > 0)
        most = max(max(fronts[0], fronts[1]), max(fronts[2], fronts[3]))
        out[k] = most / total if total > 0 else math.nan


@inner
def _support(f: Array, x0: float, y0: float, x1: float, y1: float, scale: float, prior: float) -> Any:
    """What a match counts, in units of 2^-BITS."""
    a0, b0 = f[0] * x0 + f[1] * y0 + f[2], f[3] * x0 + f[4] * y0 + f[5]
    a1, b1 = f[0] * x1 + f[3] * y1 + f[6], f[1] * x1 + f[4] * y1 + f[7]
    e = f[6] * x0 + f[7] * y0 + f[8] + a0 * x1 + b0 * y1
    slope = a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1
    gain = 1 / (1 + e * e / (slope if slope > TINY else TINY) * scale) - REST
    shift = 1.5 * 2.0 ** (52 - BITS)
    return np.int64(((gain if gain > 0 else 0.0) * (1 / (1 - REST)) * prior + shift - shift) * 2.0**BITS)


@inner
def _ray(M: Array, axis: int, x: float, y: float, depth: float) -> Any:
    """A component of a point's ray in the axes of a camera."""
    return M[2, axis] + M[0, axis] / depth * x + M[1, axis] / depth * y


@inner
def _determinant(M: Array) -> Any:
    a = M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
    return a + M[0, 1] * (M[1, 2] * M[2, 0] - M[1, 0] * M[2, 2]) + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
