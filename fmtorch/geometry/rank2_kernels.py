"""`rank2` for one matrix, compiled: matrices are (9,), row by row."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.kernel import inner
from fmtorch.compiling.scratch import vector

EPS = float(np.finfo(np.float64).eps)


@inner
def assign(target: Array, source: Array) -> None:
    """Copies vectors. (A slice assigned to a slice takes seconds to compile.)"""
    for i in range(len(target)):
        target[i] = source[i]


@inner
def assign_rows(target: Array, source: Array) -> None:
    """Copies matrices."""
    for i in range(len(target)):
        assign(target[i], source[i])


@inner
def cofactors(F: Array, C: Array) -> None:
    """The matrix of cofactors of F -> C."""
    C[0], C[1], C[2] = F[4] * F[8] - F[5] * F[7], F[5] * F[6] - F[3] * F[8], F[3] * F[7] - F[4] * F[6]
    C[3], C[4], C[5] = F[7] * F[2] - F[8] * F[1], F[8] * F[0] - F[6] * F[2], F[6] * F[1] - F[7] * F[0]
    C[6], C[7], C[8] = F[1] * F[5] - F[2] * F[4], F[2] * F[3] - F[0] * F[5], F[0] * F[4] - F[1] * F[3]


@inner
def unit(v: Array) -> None:
    """Scales to unit norm, in place; NaN where that is not possible."""
    total = 0.0
    for i in range(len(v)):
        total += v[i] * v[i]
    norm = math.sqrt(total)
    for i in range(len(v)):
        v[i] /= norm


@inner
def complement(v: Array, p: Array, q: Array) -> None:
    """Two unit vectors that complete v to an orthonormal basis (Duff et al., JCGT 2017) -> p, q."""
    sign = math.copysign(1.0, v[2])
    a = -1.0 / (sign + v[2])
    b = v[0] * v[1] * a
    p[0], p[1], p[2] = 1.0 + sign * v[0] * v[0] * a, sign * b, -sign * v[0]
    q[0], q[1], q[2] = b, sign + v[1] * v[1] * a, -v[1]


@inner
def nearest_rank2(F: Array) -> None:
    """Makes F the nearest matrix of rank two, F - F v v^T, in place, as `rank2.rank2_components`."""
    v = vector(3)
    last_right_singular_vector(F, v)
    for r in range(3):
        along = F[3 * r] * v[0] + F[3 * r + 1] * v[1] + F[3 * r + 2] * v[2]
        for c in range(3):
            F[3 * r + c] -= along * v[c]


@inner
def last_right_singular_vector(F: Array, v: Array) -> None:
    """The unit right singular vector of the smallest singular value -> v, as `rank2.last_right_singular_vector`."""
    G, C, K = vector(9), vector(9), vector(9)
    for i in range(9):
        G[i] = F[i]
    _scale(G)
    cofactors(G, C)
    if _scale(C) < 8 * EPS:
        _across_longest(G, v)
    else:
        for r in range(3):
            for c in range(3):
                K[3 * r + c] = C[r] * C[c] + C[3 + r] * C[3 + c] + C[6 + r] * C[6 + c]
        _largest_eigenvector(K, v)
    # The cofactors lose digits when s2 << s1; a step down the slope of |F v|^2 takes out what is left of the first.
    norm2, slope, size = 0.0, np.zeros(3), 0.0
    for r in range(3):
        along = G[3 * r] * v[0] + G[3 * r + 1] * v[1] + G[3 * r + 2] * v[2]
        for c in range(3):
            slope[c] += G[3 * r + c] * along
            norm2 += G[3 * r + c] * G[3 * r + c]
    for c in range(3):
        slope[c] = v[c] - slope[c] / (norm2 if norm2 > 0 else 1.0)
        size += slope[c] * slope[c]
    if size > 0:
        for c in range(3):
            v[c] = slope[c] / math.sqrt(size)


@inner
def _scale(A: Array) -> Any:
    """A over its largest entry, in place; that entry's magnitude."""
    peak = 0.0
    for i in range(9):
        peak = max(peak, abs(A[i]))
    if peak > 0:
        for i in range(9):
            A[i] /= peak
    return peak


@inner
def _longest(A: Array) -> tuple[int, float]:
    """The longest row of A and its squared length."""
    best, most = 0, -1.0
    for r in range(3):
        length2 = A[3 * r] * A[3 * r] + A[3 * r + 1] * A[3 * r + 1] + A[3 * r + 2] * A[3 * r + 2]
        if length2 > most:
            best, most = r, length2
    return best, most


@inner
def _across_longest(A: Array, v: Array) -> None:
    """A unit vector perpendicular to the longest row of A -> v."""
    row, other = np.zeros(3), vector(3)
    best, length2 = _longest(A)
    for c in range(3):
        row[c] = A[3 * best + c] / math.sqrt(length2) if length2 > 0 else 0.0
    complement(row, v, other)


@inner
def _largest_eigenvector(K: Array, v: Array) -> None:
    """The unit eigenvector of the largest eigenvalue of a symmetric matrix -> v; K is overwritten."""
    mean, squares = (K[0] + K[4] + K[8]) / 3, 0.0
    for i in range(0, 9, 4):
        K[i] -= mean
    for i in range(9):
        squares += K[i] * K[i]
    m = math.sqrt(squares / 6)
    for i in range(9):
        K[i] /= m if m > 0 else 1.0
    C = vector(9)
    cofactors(K, C)
    determinant = min(max(K[0] * C[0] + K[1] * C[1] + K[2] * C[2], -2.0), 2.0)
    y = 2.0
    for _ in range(5):
        y = (2 * y * y * y + abs(determinant)) / (3 * (y * y - 1))
    largest = y if determinant >= 0 else (math.sqrt(3 * max(2 - y, 0.0) * (2 + y)) + y) / 2
    for i in range(0, 9, 4):
        K[i] -= largest
    cofactors(K, C)
    best, length2 = _longest(C)
    if length2 > EPS:
        for c in range(3):
            v[c] = C[3 * best + c] / math.sqrt(length2)
    else:
        _across_longest(K, v)
