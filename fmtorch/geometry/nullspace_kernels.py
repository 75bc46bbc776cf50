"""`nullspace` for LANES samples at a time, compiled: flat buffers whose innermost axis is the sample."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.kernels import inner

Array = NDArray[Any]
LANES = 16  # samples
RANK_TOLERANCE2 = float((64 * np.finfo(np.float64).eps) ** 2)  # as in `nullspace`, of squared lengths


@inner
def gather(points: Array, sample: Array, first: int, size: int, X: Array) -> None:
    """Points (4, n) of the samples (size, s) from `first` on -> X (4, size * LANES); the last fills what is left."""
    for j in range(size):
        for lane in range(LANES):
            i = sample[j, min(first + lane, sample.shape[1] - 1)]
            for k in range(4):
                X[k, j * LANES + lane] = points[k, i]


@inner
def equations(X: Array, size: int, A: Array) -> None:
    """The rows a with a . vec(F) = x1^T F x0 -> A (size, 9, LANES), flat."""
    X0, Y0, X1, Y1 = X[0], X[1], X[2], X[3]
    for r in range(size):
        o, p = 9 * r * LANES, r * LANES
        for lane in range(LANES):
            x0, y0, x1, y1 = X0[p + lane], Y0[p + lane], X1[p + lane], Y1[p + lane]
            A[o + lane], A[o + LANES + lane], A[o + 2 * LANES + lane] = x1 * x0, x1 * y0, x1
            A[o + 3 * LANES + lane], A[o + 4 * LANES + lane], A[o + 5 * LANES + lane] = y1 * x0, y1 * y0, y1
            A[o + 6 * LANES + lane], A[o + 7 * LANES + lane], A[o + 8 * LANES + lane] = x0, y0, 1.0


@inner
def null_space(A: Array, m: int, B: Array, full_rank: Array, work: Array) -> None:
    """An orthonormal basis of the null space of A (m, 9, LANES), which is overwritten -> B (9 - m, 9, LANES), flat.

    full_rank: (LANES,), whether each matrix has rank m. work: ((m + 2) LANES,).
    """
    sums, lengths = m * LANES, (m + 1) * LANES
    for lane in range(LANES):
        full_rank[lane] = True
    for k in range(m):
        _dot(A, 9 * k, A, 9 * k, 9, work, lengths)
        for earlier in range(k):  # the reflections so far
            _reflect(A, 9 * earlier + earlier, A, 9 * k + earlier, 9 - earlier, work, earlier * LANES, sums)
        head = (9 * k + k) * LANES
        _dot(A, 9 * k + k, A, 9 * k + k, 9 - k, work, sums)
        for lane in range(LANES):
            left = work[sums + lane]
            full_rank[lane] &= left > RANK_TOLERANCE2 * work[lengths + lane]
            shift = math.copysign(math.sqrt(left if left > 0 else 1.0), A[head + lane])
            A[head + lane] += shift
            work[k * LANES + lane] = 1.0 / (shift * A[head + lane])
    for j in range(9 - m):
        for c in range(9):
            for lane in range(LANES):
                B[(9 * j + c) * LANES + lane] = 1.0 if c == m + j else 0.0
        for k in range(m - 1, -1, -1):
            _reflect(A, 9 * k + k, B, 9 * j + k, 9 - k, work, k * LANES, sums)


@inner
def _dot(A: Array, a: int, B: Array, b: int, n: int, out: Array, o: int) -> None:
    """Products of n components from A[a] and B[b] on, summed -> out[o : o + LANES]."""
    for lane in range(LANES):
        out[o + lane] = 0.0
    for c in range(n):
        p, q = (a + c) * LANES, (b + c) * LANES
        for lane in range(LANES):
            out[o + lane] += A[p + lane] * B[q + lane]


@inner
def _reflect(A: Array, a: int, B: Array, b: int, n: int, work: Array, scale: int, sums: int) -> None:
    """Reflects the n components of B from b on across the plane normal to those of A from a on."""
    _dot(A, a, B, b, n, work, sums)
    for lane in range(LANES):
        work[sums + lane] *= work[scale + lane]
    for c in range(n):
        p, q = (a + c) * LANES, (b + c) * LANES
        for lane in range(LANES):
            B[q + lane] -= work[sums + lane] * A[p + lane]
