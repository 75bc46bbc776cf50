"""Two cameras near a fundamental matrix, of the candidates of one pair, compiled.

axes: (k, 2, 3, 3), U and V of ``E = U diag(1, 1, 0) V^T``, rows first. focal: (k, 2), logarithms of focal lengths in
units of the longer sides. longest: (2,), these sides in the unit of the points.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner, kernel
from fmtorch.estimators.focal.prior_kernels import LOG_USUAL
from fmtorch.geometry.arithmetic_kernels import exponential, logarithm
from fmtorch.geometry.rank2_kernels import complement
from fmtorch.geometry.rank2_manifold_kernels import start_one

Array = NDArray[Any]
MIN_FOCAL, MAX_FOCAL = 0.25, 5.0  # as in `cameras`
SQUARINGS = 5  # as in `rank2_manifold`


@kernel("f8[:, ::1], f8[::1], f8[:, ::1]", brief=True)
def translate(F: Array, offset: Array, out: Array) -> None:
    """Models (k, 9) for points from which the offset (4,) is taken -> out (k, 9)."""
    for k in range(len(F)):
        for r in range(3):
            a, b = F[k, 3 * r], F[k, 3 * r + 1]
            out[k, 3 * r], out[k, 3 * r + 1] = a, b
            out[k, 3 * r + 2] = F[k, 3 * r + 2] + offset[0] * a + offset[1] * b
        for c in range(3):
            out[k, 6 + c] += offset[2] * out[k, c] + offset[3] * out[k, 3 + c]


@kernel("f8[:, ::1], f8[::1], f8, f8[:, ::1]", brief=True)
def centre(table: Array, offset: Array, scale_px: float, out: Array) -> None:
    """Points from the principal points, squared scales of a loss, and one over these -> out (6, n).

    table: (9, n), of `OnePair`. offset: (4,), what is added to points. scale_px: of the loss, of a usual match.
    """
    for i in range(table.shape[1]):
        for r in range(4):
            out[r, i] = table[r, i] + offset[r]
        scale = table[5, i]
        out[4, i], out[5, i] = (scale_px / scale) * (scale_px / scale), (scale / scale_px) * (scale / scale_px)


@kernel("f8[:, ::1], f8[::1], f8[::1], f8[:, :, :, ::1], f8[:, ::1]", brief=True)
def nearest_cameras(F: Array, offset: Array, longest: Array, axes: Array, focal: Array) -> None:
    """Cameras near models (k, 9): those of their focal lengths, or of usual ones where these are implausible.

    offset: (4,), what is added to the models' points to have them from the principal points.
    """
    shifted = np.empty(F.shape)
    translate(F, -offset, shifted)
    G, M, e0, e1 = np.empty(9), np.empty(9), np.empty(3), np.empty(3)
    p, q, a, b = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(shifted)):
        start_one(shifted[k], SQUARINGS, G, e0, e1)
        first = _squared_focal(G, 1, 3, e1) / (longest[0] * longest[0])
        second = _squared_focal(G, 3, 1, e0) / (longest[1] * longest[1])
        plausible = MIN_FOCAL**2 < first < MAX_FOCAL**2 and MIN_FOCAL**2 < second < MAX_FOCAL**2
        focal[k, 0] = logarithm(first) / 2 if plausible else LOG_USUAL
        focal[k, 1] = logarithm(second) / 2 if plausible else LOG_USUAL
        d0 = 1 / (exponential(focal[k, 0]) * longest[0])
        d1 = 1 / (exponential(focal[k, 1]) * longest[1])
        for r in range(3):
            G[3 * r + 2] *= d0
        for c in range(3):
            G[6 + c] *= d1
        start_one(G, 0, M, e0, e1)
        complement(e0, p, q)
        complement(e1, a, b)
        m00, m01, m10, m11 = 0.0, 0.0, 0.0, 0.0
        for r in range(3):
            Mp = M[3 * r] * p[0] + M[3 * r + 1] * p[1] + M[3 * r + 2] * p[2]
            Mq = M[3 * r] * q[0] + M[3 * r + 1] * q[1] + M[3 * r + 2] * q[2]
            m00, m01, m10, m11 = m00 + a[r] * Mp, m01 + a[r] * Mq, m10 + b[r] * Mp, m11 + b[r] * Mq
        sign = 1.0 if m00 * m11 >= m01 * m10 else -1.0
        cosine, sine = m00 + sign * m11, m10 - sign * m01
        norm = math.sqrt(cosine * cosine + sine * sine)
        cosine, sine = cosine / norm, sine / norm
        for r in range(3):
            axes[k, 0, r, 0], axes[k, 0, r, 1] = a[r] * cosine + b[r] * sine, sign * (b[r] * cosine - a[r] * sine)
            axes[k, 1, r, 0], axes[k, 1, r, 1] = p[r], q[r]
            axes[k, 0, r, 2], axes[k, 1, r, 2] = e1[r], e0[r]


@inner
def _squared_focal(F: Array, column: int, row: int, e: Array) -> Any:
    """Bougnoux's formula for the camera whose points F's columns belong to; with steps exchanged, for the other."""
    r0 = -F[0] * e[1] + F[row] * e[0]
    r1 = -F[column] * e[1] + F[row + column] * e[0]
    r2 = -F[2 * column] * e[1] + F[row + 2 * column] * e[0]
    return -(r2 * F[8]) / (r0 * F[2 * row] + r1 * F[2 * row + column])
