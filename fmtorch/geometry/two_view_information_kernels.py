"""`two_view_information` of one pair, compiled: matrices are (9,), row by row, between centred pixels."""

from __future__ import annotations

import math

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.kernel import inner
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.geometry.rank2_kernels import complement

PARAMETERS, WINDOW, ITERATIONS, MIN_NOISE_PX, MIN_SPARE_MATCHES = 7, 2.5, 8, 1e-3, 3  # as in `two_view_information`
TERMS, WIDEST = 64, 6.0


@inner
def tangents(R: Array, t: Array, focal: Array, F: Array, slopes: Array, basis: Array) -> None:
    """F (9,) between centred pixels, its derivatives by the parameters (7, 9), and the tangents of t (2, 3)."""
    e, shift, A, B = vector(3), vector(3), matrix(3, 3), matrix(3, 3)
    norm = math.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    for i in range(3):
        e[i] = t[i] / norm
    complement(e, basis[0], basis[1])
    for k in range(PARAMETERS + 1):
        for i in range(3):
            shift[i] = basis[k - 3, i] if 3 <= k < 5 else e[i]
            for c in range(3):
                A[i, c] = R[i, c]
        if k < 3:  # the cross products of an axis with the columns of R
            for c in range(3):
                A[k, c], A[(k + 1) % 3, c], A[(k + 2) % 3, c] = 0.0, -R[(k + 2) % 3, c], R[(k + 1) % 3, c]
        for c in range(3):
            B[0, c] = shift[1] * A[2, c] - shift[2] * A[1, c]
            B[1, c] = shift[2] * A[0, c] - shift[0] * A[2, c]
            B[2, c] = shift[0] * A[1, c] - shift[1] * A[0, c]
        for i in range(3):
            for c in range(3):
                scale = (1 / focal[1] if i < 2 else 1.0) * (1 / focal[0] if c < 2 else 1.0)
                by = (-1.0 if c < 2 else 0.0) if k == 5 else (-1.0 if i < 2 else 0.0) if k == 6 else 1.0
                if k < PARAMETERS:
                    slopes[k, 3 * i + c] = B[i, c] * scale * by
                else:
                    F[3 * i + c] = B[i, c] * scale


@inner
def distance(F: Array, x: float, y: float, u: float, v: float) -> tuple[float, float, float, float, float, float]:
    """The signed Sampson distance, the unit normal (4,) by x, y, u, v, and one over the slope."""
    a1, b1, c1 = F[0] * x + F[1] * y + F[2], F[3] * x + F[4] * y + F[5], F[6] * x + F[7] * y + F[8]
    a0, b0 = F[0] * u + F[3] * v + F[6], F[1] * u + F[4] * v + F[7]
    q = a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1
    root = 1 / math.sqrt(q) if q > 0 else 0.0
    return (a1 * u + b1 * v + c1) * root, a0 * root, b0 * root, a1 * root, b1 * root, root


@inner
def kept_share(c: float) -> float:
    """m / A of a limit c."""
    square, term, total = min(c, WIDEST) * min(c, WIDEST), 1.0, 1.0
    for k in range(1, TERMS + 1):
        term *= square / (2 * k + 1)
        total += term
    return 1 - 1 / total


@inner
def noise_of(r: Array, w: Array, T: float, parameters: float) -> float:
    """The noise of matches by their distances."""
    share, total, square = kept_share(WINDOW), 0.0, 0.0
    for i in range(len(r)):
        total += w[i]
        square += w[i] * r[i] * r[i]
    s = max(0.6 * T if math.inf > T else math.sqrt(square / max(total, 1e-300)), MIN_NOISE_PX)
    for _ in range(ITERATIONS):
        count, total, squares, square = 0, 0.0, 0.0, 0.0
        for i in range(len(r)):
            if r[i] < WINDOW * s:
                count, total, squares = count + 1, total + w[i], squares + w[i] * w[i]
                square += w[i] * r[i] * r[i]
        if count < parameters + MIN_SPARE_MATCHES:
            break
        spare = share * (total - parameters * share * squares / total)
        if spare > 0:
            s = min(max(math.sqrt(square / spare), MIN_NOISE_PX), T)
    return s


@inner
def add_information(
    F: Array, slopes: Array, x: float, y: float, u: float, v: float, weight: float, s: float, M: Array, noise: Array
) -> None:
    """Adds the information of a match of noise s, weighted, to M (7, 7), and what noise gives of it to noise (2, 2).

    The derivatives are those of the distance at the points that are corrected to first order.
    """
    r, p, q, m, n, root = distance(F, x, y, u, v)
    x, y, u, v = x - r * p, y - r * q, u - r * m, v - r * n
    J, by_point = vector(PARAMETERS), matrix(2, 4)
    for k in range(PARAMETERS):
        D = slopes[k]
        a, b, c = D[0] * x + D[1] * y + D[2], D[3] * x + D[4] * y + D[5], D[6] * x + D[7] * y + D[8]
        J[k] = (a * u + b * v + c) * root / s
        if 3 <= k < 5:
            d, e = (D[0] * u + D[3] * v + D[6]) * root, (D[1] * u + D[4] * v + D[7]) * root
            a, b = a * root, b * root
            along = d * p + e * q + a * m + b * n
            by_point[k - 3, 0], by_point[k - 3, 1] = d - along * p, e - along * q
            by_point[k - 3, 2], by_point[k - 3, 3] = a - along * m, b - along * n
    for k in range(PARAMETERS):
        for j in range(k + 1):
            M[k, j] += weight * J[k] * J[j]
    for k in range(2):
        for j in range(2):
            for i in range(4):
                noise[k, j] += weight * by_point[k, i] * by_point[j, i]
