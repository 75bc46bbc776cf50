"""The five-point algorithm on the samples of one pair, compiled; float64, LANES samples at a time, models in float32.

As `five_point`: Nister (PAMI 2004), real roots by changes of sign on a grid. Buffers are rows, their last axis is the
sample.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.geometry.nullspace_kernels import LANES, equations, gather, null_space
from fmtorch.geometry.orientation_kernels import consistently_oriented
from fmtorch.geometry.real_roots_kernels import MOST, real_roots
from fmtorch.kernels import inner, kernel

Array = NDArray[Any]
_MONOMIALS = (
    "000", "111", "001", "011", "002", "003", "112", "113", "012", "013",
    "022", "023", "033", "122", "123", "133", "222", "223", "233", "333",
)  # fmt: skip
_PAIRS = tuple(itertools.combinations_with_replacement(range(4), 2))
FIRST, SECOND = (np.array([pair[k] for pair in _PAIRS]) for k in (0, 1))
MONOMIAL = np.array([[_MONOMIALS.index("".join(map(str, sorted((*pair, c))))) for c in range(4)] for pair in _PAIRS])


@kernel("f8[:, ::1], i8[:, ::1], f8[:, ::1], f8[::1], f4[:, ::1], i8[::1]")
def five_point(points: Array, sample: Array, depth: Array, offset: Array, F: Array, draw: Array) -> int:
    """Consistently oriented models of samples (5, s) of points (4, n) -> F (10 s, 9), draw (10 s,); their number.

    points: from the principal points. depth: (2, s), the focal lengths of each sample, in the unit of the points.
    offset: (4,), from the centre of the coordinates that F is for to the principal points. In the order of the samples.
    """
    X, A, e = np.empty((4, 5 * LANES)), np.empty((45, LANES)), np.empty((36, LANES))
    work, full_rank, C = np.empty((7, LANES)), np.empty(LANES, np.bool_), np.empty((200, LANES))
    B, p = np.empty((45, LANES)), np.empty((11, LANES))
    lane, chart, z = np.empty(MOST, np.int64), np.empty(MOST, np.int64), np.empty(MOST)
    E, models = np.empty(9), 0
    for first in range(0, sample.shape[1], LANES):
        gather(points, sample, first, 5, X)
        for k in range(4):
            for j in range(5):
                for i in range(LANES):
                    X[k, j * LANES + i] /= depth[k // 2, min(first + i, sample.shape[1] - 1)]
        equations(X, 5, A)
        null_space(A, 5, e, full_rank, work)
        _constraints(e, C)
        _eliminate(C, work)
        _polynomials(C, B)
        _determinant(B, p)
        count = real_roots(p, min(LANES, sample.shape[1] - first), full_rank, lane, chart, z)
        for r in range(count):
            i = lane[r]
            valid = _essential(B, e, i, chart[r] == 1, z[r], E) and consistently_oriented(E, X, 5, LANES, i)
            if valid and _uncalibrated(E, depth[0, first + i], depth[1, first + i], offset, F[models]):
                draw[models] = first + i
                models += 1
    return models


@inner
def _constraints(e: Array, A: Array) -> None:
    """``det E = 0`` and ``E E^T E - tr(E E^T) E / 2 = 0`` for E = x X + y Y + z Z + W -> A (10 20, LANES).

    e: (4 9, LANES), the basis X, Y, Z, W.
    """
    Q, N = np.empty((9, LANES)), np.empty((3, LANES))
    for r in range(200):
        for i in range(LANES):
            A[r, i] = 0.0
    for pair in range(10):
        a, b = 9 * FIRST[pair], 9 * SECOND[pair]
        _quadratic_forms(e, a, b, 0.5 if a == b else 1.0, Q, N)
        for c in range(4):
            m, o = MONOMIAL[pair, c], 9 * c
            for i in range(LANES):
                A[m, i] += N[0, i] * e[o, i] + N[1, i] * e[o + 1, i] + N[2, i] * e[o + 2, i]
            for row in range(3):
                q = 3 * row
                for column in range(3):
                    w, f = (1 + q + column) * 20 + m, o + column
                    for i in range(LANES):
                        A[w, i] += Q[q, i] * e[f, i] + Q[q + 1, i] * e[f + 3, i] + Q[q + 2, i] * e[f + 6, i]


@inner
def _quadratic_forms(e: Array, a: int, b: int, share: float, Q: Array, N: Array) -> None:
    """Of the product of two unknowns the coefficients of E E^T - tr / 2 -> Q (3 3,) and of minors of E -> N (3,)."""
    for row in range(3):
        for column in range(row, 3):
            p, q, r, s = a + 3 * row, b + 3 * column, b + 3 * row, a + 3 * column
            u, v = 3 * row + column, 3 * column + row
            for i in range(LANES):
                value = e[p, i] * e[q, i] + e[p + 1, i] * e[q + 1, i]
                value += e[p + 2, i] * e[q + 2, i]
                value += e[r, i] * e[s, i] + e[r + 1, i] * e[s + 1, i]
                value = (value + e[r + 2, i] * e[s + 2, i]) * share
                Q[u, i] = value
                Q[v, i] = value
    for i in range(LANES):
        half = (Q[0, i] + Q[4, i] + Q[8, i]) / 2
        Q[0, i] -= half
        Q[4, i] -= half
        Q[8, i] -= half
    for k in range(3):  # rows 1 and 2 without column k
        p, q, r, s = 3 + (k + 1) % 3, 6 + (k + 2) % 3, 3 + (k + 2) % 3, 6 + (k + 1) % 3
        for i in range(LANES):
            value = e[a + p, i] * e[b + q, i] - e[a + r, i] * e[b + s, i]
            N[k, i] = (value + e[b + p, i] * e[a + q, i] - e[b + r, i] * e[a + s, i]) * share


@inner
def _eliminate(A: Array, work: Array) -> None:
    """Gauss elimination of A (10 20, LANES) without pivoting, in place; wholly of the last six rows."""
    for k in range(10):
        for i in range(LANES):
            work[0, i] = 1.0 / A[21 * k, i]
        for c in range(k + 1, 20):
            for i in range(LANES):
                A[20 * k + c, i] *= work[0, i]
        for r in range(k + 1, 10):
            _subtract(A, 20 * r + k, 20 * r, 20 * k, k + 1, work)
    for r in range(8, 3, -1):
        for k in range(9, r, -1):
            _subtract(A, 20 * r + k, 20 * r, 20 * k, 10, work)


@inner
def _subtract(A: Array, factor: int, row: int, other: int, first: int, work: Array) -> None:
    """Subtracts from a row the factor times the other one, from a column on."""
    for i in range(LANES):
        work[0, i] = A[factor, i]
    for c in range(first, 20):
        for i in range(LANES):
            A[row + c, i] -= work[0, i] * A[other + c, i]


@inner
def _polynomials(A: Array, B: Array) -> None:
    """The 3 x 3 matrix of polynomials in z, highest power first, of null vector (x, y, 1) -> B (3 3 5, LANES)."""
    for q in range(45):
        for i in range(LANES):
            B[q, i] = 0.0
    for r in range(3):
        for column in range(3):
            first, count = 10 + 3 * column, 4 if column == 2 else 3
            for s in range(count):
                o = (3 * r + column) * 5 + 5 - count + s
                p, q = 20 * (4 + 2 * r) + first + s, 20 * (5 + 2 * r) + first + s
                for i in range(LANES):
                    B[o, i] += A[p, i]
                for i in range(LANES):
                    B[o - 1, i] -= A[q, i]


@inner
def _determinant(B: Array, p: Array) -> None:
    """The determinant of B, a polynomial of degree ten -> p (11, LANES)."""
    minor = np.empty((7, LANES))
    for q in range(11):
        for i in range(LANES):
            p[q, i] = 0.0
    for r in range(3):
        s, t = (r + 1) % 3, (r + 2) % 3
        for q in range(7):
            for i in range(LANES):
                minor[q, i] = 0.0
        _multiply(B, 15 * s + 1, 4, B, 15 * t + 6, 4, 1.0, minor)
        _multiply(B, 15 * s + 6, 4, B, 15 * t + 1, 4, -1.0, minor)
        _multiply(minor, 0, 7, B, 15 * r + 10, 5, 1.0, p)


@inner
def _multiply(a: Array, o: int, m: int, b: Array, q: int, n: int, sign: float, out: Array) -> None:
    """Adds to a polynomial the product of two of m and n coefficients, which begin at a[o] and b[q]."""
    for j in range(m):
        for k in range(n):
            for i in range(LANES):
                out[j + k, i] += sign * a[o + j, i] * b[q + k, i]


@inner
def _essential(B: Array, e: Array, i: int, far: bool, z: float, E: Array) -> bool:
    """The essential matrix of a root of sample i, of unit norm -> E (9,); whether there is one."""
    m, norm = np.empty(9), 0.0
    for q in range(9):
        value = B[5 * q + (4 if far else 0), i]
        for d in range(1, 5):
            value = B[5 * q + (4 - d if far else d), i] + value * z
        m[q] = value
    x, y, one, most = 0.0, 0.0, 0.0, -1.0
    for r in range(3):  # the longest cross product of two rows
        a, b = 3 * r, 3 * ((r + 1) % 3)
        c0, c1 = m[a + 1] * m[b + 2] - m[a + 2] * m[b + 1], m[a + 2] * m[b] - m[a] * m[b + 2]
        c2 = m[a] * m[b + 1] - m[a + 1] * m[b]
        length2 = c0 * c0 + c1 * c1 + c2 * c2
        if length2 > most:
            x, y, one, most = c0, c1, c2, length2
    w0, w1, w2, w3 = (x * z, y * z, one, one * z) if far else (x, y, one * z, one)
    for q in range(9):
        E[q] = e[q, i] * w0 + e[9 + q, i] * w1
        E[q] += e[18 + q, i] * w2 + e[27 + q, i] * w3
        norm += E[q] * E[q]
    norm = math.sqrt(norm)
    for q in range(9):
        E[q] /= norm
    return math.isfinite(norm) and norm > 0


@inner
def _uncalibrated(E: Array, depth0: float, depth1: float, offset: Array, F: Array) -> bool:
    """The fundamental matrix of cameras of these focal lengths, of unit norm -> F (9,), float32; E is overwritten."""
    norm = 0.0
    for k in range(3):
        E[3 * k + 2] *= depth0
    for k in range(3):
        E[6 + k] *= depth1
    for k in range(3):
        E[3 * k + 2] += offset[0] * E[3 * k] + offset[1] * E[3 * k + 1]
    for k in range(3):
        E[6 + k] += offset[2] * E[k] + offset[3] * E[3 + k]
    for q in range(9):
        norm += E[q] * E[q]
    norm = math.sqrt(norm)
    for q in range(9):
        F[q] = E[q] / norm
    return math.isfinite(norm) and norm > 0
