"""`nullspace` for LANES samples at a time, compiled: buffers of rows whose last axis is the sample.

One index for the row and one for the lane: with one for both, numba asks of each lane whether it is negative, and LLVM
gathers what is contiguous.
"""

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
    """The rows a with a . vec(F) = x1^T F x0 -> A (9 size, LANES)."""
    X0, Y0, X1, Y1 = X[0], X[1], X[2], X[3]
    for r in range(size):
        o, p = 9 * r, r * LANES
        for lane in range(LANES):
            x0, y0, x1, y1 = X0[p + lane], Y0[p + lane], X1[p + lane], Y1[p + lane]
            A[o, lane], A[o + 1, lane], A[o + 2, lane] = x1 * x0, x1 * y0, x1
            A[o + 3, lane], A[o + 4, lane], A[o + 5, lane] = y1 * x0, y1 * y0, y1
            A[o + 6, lane], A[o + 7, lane], A[o + 8, lane] = x0, y0, 1.0


@inner
def null_space(A: Array, m: int, B: Array, full_rank: Array, work: Array) -> None:
    """An orthonormal basis of the null space of A (m 9, LANES), which is overwritten -> B ((9 - m) 9, LANES).

    full_rank: (LANES,), whether each matrix has rank m. work: (m + 2, LANES).
    """
    sums, lengths = m, m + 1
    for lane in range(LANES):
        full_rank[lane] = True
    for k in range(m):
        _dot(A, 9 * k, A, 9 * k, 9, work, lengths)
        for earlier in range(k):  # the reflections so far
            _reflect(A, 9 * earlier + earlier, A, 9 * k + earlier, 9 - earlier, work, earlier, sums)
        head = 9 * k + k
        _dot(A, head, A, head, 9 - k, work, sums)
        for lane in range(LANES):
            left = work[sums, lane]
            full_rank[lane] &= left > RANK_TOLERANCE2 * work[lengths, lane]
            shift = math.copysign(math.sqrt(left if left > 0 else 1.0), A[head, lane])
            A[head, lane] += shift
            work[k, lane] = 1.0 / (shift * A[head, lane])
    for j in range(9 - m):
        for c in range(9):
            for lane in range(LANES):
                B[9 * j + c, lane] = 1.0 if c == m + j else 0.0
        for k in range(m - 1, -1, -1):
            _reflect(A, 9 * k + k, B, 9 * j + k, 9 - k, work, k, sums)


@inner
def _dot(A: Array, a: int, B: Array, b: int, n: int, out: Array, o: int) -> None:
    """Products of n components from A[a] and B[b] on, summed -> out[o]."""
    for lane in range(LANES):
        out[o, lane] = 0.0
    for c in range(n):
        for lane in range(LANES):
            out[o, lane] += A[a + c, lane] * B[b + c, lane]


@inner
def _reflect(A: Array, a: int, B: Array, b: int, n: int, work: Array, scale: int, sums: int) -> None:
    """Reflects the n components of B from b on across the plane normal to those of A from a on."""
    _dot(A, a, B, b, n, work, sums)
    for lane in range(LANES):
        work[sums, lane] *= work[scale, lane]
    for c in range(n):
        for lane in range(LANES):
            B[b + c, lane] -= work[sums, lane] * A[a + c, lane]
