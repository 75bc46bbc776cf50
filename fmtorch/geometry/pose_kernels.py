"""`pose` for one pair of cameras with square pixels, compiled; and the essential matrix nearest to a model."""

from __future__ import annotations

import math
from typing import Any

from fmtorch.compiling.arrays import Array, F8x1, F8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.geometry.rank2_kernels import complement
from fmtorch.geometry.rank2_manifold_kernels import SQUARINGS, start_one

WEIGHT_BITS = 20  # fractional, of weights, so that their sums are exact
RANK_2 = 1e-10  # share of the squared norm that the product of the singular values must exceed


@inner
def nearest_axes(M: Array, e0: Array, e1: Array, U: Array, V: Array) -> Any:
    """U and V (3, 3) of the essential matrix nearest to M (9,), whose epipoles are e0, e1; whether M has rank 2.

    In the planes across the epipoles M is 2 x 2; its nearest orthogonal matrix gives both singular values 1.
    """
    p, q, a, b = vector(3), vector(3), vector(3), vector(3)
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
        U[r, 0], U[r, 1] = a[r] * cosine + b[r] * sine, sign * (b[r] * cosine - a[r] * sine)
        V[r, 0], V[r, 1] = p[r], q[r]
        U[r, 2], V[r, 2] = e1[r], e0[r]
    return abs(m00 * m11 - m01 * m10) > RANK_2 * norm * norm


@kernel(holds_gil=True)
def pose(F: F8x2, cameras: F8x1, x0: F8x2, x1: F8x2, weight: F8x1, out: F8x1) -> None:
    """The pose of a fundamental matrix (3, 3), of four the one with the most support in front -> out (13,).

    cameras: (6,), focal length and principal point of both. x0, x1: (n, 2). weight: (n,), in [0, 1], by which matches
    count. out: R row by row, t of unit length, and 1; all zero where there is no pose.
    """
    M, G, e0, e1, U, V, R = vector(9), vector(9), vector(3), vector(3), matrix(3, 3), matrix(3, 3), matrix(6, 3)
    f0, u0, v0, f1, u1, v1 = cameras
    for r in range(3):  # E = K1^T F K0
        G[3 * r], G[3 * r + 1] = F[r, 0] * f0, F[r, 1] * f0
        G[3 * r + 2] = F[r, 0] * u0 + F[r, 1] * v0 + F[r, 2]
    for c in range(3):
        M[c], M[3 + c] = G[c] * f1, G[3 + c] * f1
        M[6 + c] = G[c] * u1 + G[3 + c] * v1 + G[6 + c]
    start_one(M, SQUARINGS, G, e0, e1)
    valid = nearest_axes(G, e0, e1, U, V)
    handed = _determinant(U) * _determinant(V)
    for r in range(3):
        for c in range(3):
            turned, straight = U[r, 1] * V[c, 0] - U[r, 0] * V[c, 1], U[r, 2] * V[c, 2] * handed
            R[r, c], R[3 + r, c] = straight + turned, straight - turned
    support = vector(4)
    for i in range(4):
        support[i] = 0.0
    a, b = vector(3), vector(3)
    a[2] = b[2] = 1.0
    for i in range(len(weight)):
        if weight[i] > 0:
            a[0], a[1] = (x0[i, 0] - u0) / f0, (x0[i, 1] - v0) / f0
            b[0], b[1] = (x1[i, 0] - u1) / f1, (x1[i, 1] - v1) / f1
            _vote(R, U, a, b, math.floor(min(weight[i], 1.0) * 2.0**WEIGHT_BITS + 0.5), support)
    best = 0
    for i in range(1, 4):
        best = i if support[i] > support[best] else best
    for r in range(3):
        out[9 + r] = U[r, 2] if best < 2 else -U[r, 2]
        for c in range(3):
            out[3 * r + c] = R[3 * (best % 2) + r, c]
    finite = valid and support[best] > 0
    for i in range(12):
        finite = finite and math.isfinite(out[i])
    for i in range(12):
        out[i] = out[i] if finite else 0.0
    out[12] = 1.0 if finite else 0.0


@inner
def _vote(R: Array, U: Array, a: Array, b: Array, weight: float, support: Array) -> None:
    """Adds the weight of a match of rays a, b to the poses R[:3], R[3:], and these with -t, in front of which it lies.

    Least squares on d1 b = d0 R a + t: the signs of the depths are those of n (b x t) and n (R a x t), n = R a x b.
    """
    for k in range(2):
        p, q, r = 0.0, 0.0, 0.0
        for i in range(3):
            p += R[3 * k, i] * a[i]
            q += R[3 * k + 1, i] * a[i]
            r += R[3 * k + 2, i] * a[i]
        nx, ny, nz = q * b[2] - r * b[1], r * b[0] - p * b[2], p * b[1] - q * b[0]
        tx, ty, tz = U[0, 2], U[1, 2], U[2, 2]
        depth0 = nx * (b[1] * tz - b[2] * ty) + ny * (b[2] * tx - b[0] * tz) + nz * (b[0] * ty - b[1] * tx)
        depth1 = nx * (q * tz - r * ty) + ny * (r * tx - p * tz) + nz * (p * ty - q * tx)
        if depth0 > 0 and depth1 > 0:
            support[k] += weight
        if depth0 < 0 and depth1 < 0:
            support[2 + k] += weight


@inner
def _determinant(M: Array) -> Any:
    """The sign of the determinant (3, 3) of orthogonal columns."""
    a = M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
    b = M[0, 1] * (M[1, 2] * M[2, 0] - M[1, 0] * M[2, 2]) + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
    return 1.0 if a + b > 0 else -1.0
