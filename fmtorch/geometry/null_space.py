"""The null space of wide matrices by Householder reflections, LANES samples at a time.

Buffers are rows of LANES numbers, one a sample."""

from typing import Any

import numpy as np

from fmtorch.jit.kernel import Array, inner
from fmtorch.jit.lanes import LANES, copysign, fill, load, sqrt, store, where

RANK_TOLERANCE2 = float((64 * np.finfo(np.float64).eps) ** 2)  # of a row's squared length: what is left is rounding


@inner
def gather(points: Array, sample: Array, first: int, X: Array) -> None:
    """Points (4, n) of the samples (size, s) from `first` on -> X (4 size, LANES); the last fills what is left."""
    for lane in range(LANES):
        column = min(first + lane, sample.shape[1] - 1)
        for j in range(len(sample)):
            i = sample[j, column]
            for k in range(4):
                X[4 * j + k, lane] = points[k, i]


@inner
def add_models(f: Array, there: Array, first: int, F: Array, draw: Array, models: int, samples: int) -> int:
    """Adds the models f (k, 9, LANES) that are there (k, LANES), of the samples from `first` on, to F and draw.
    models: in these so far. samples: in all. Returns how many models there are then."""
    for lane in range(min(LANES, samples - first)):
        for k in range(len(there)):
            if there[k, lane]:
                for q in range(9):
                    F[models, q] = f[k, q, lane]
                draw[models] = first + lane
                models += 1
    return models


@inner
def equations(X: Array, size: int, A: Array) -> None:
    """The rows a with a . vec(F) = x1^T F x0 of points X (4 size, LANES) -> A (9 size, LANES)."""
    for j in range(size):
        o, p = 9 * j, 4 * j
        x0, y0, x1, y1 = load(X, p), load(X, p + 1), load(X, p + 2), load(X, p + 3)
        store(A, o, (x1 * x0, x1 * y0, x1, y1 * x0, y1 * y0, y1, x0, y0, fill(1.0)))


@inner
def null_space(A: Array, m: int, B: Array, scale: Array) -> Any:
    """An orthonormal basis of the null space of A (m 9, LANES), which is overwritten -> B ((9 - m) 9, LANES).
    The last columns of Q in A^T = Q R (Golub and Van Loan, Matrix Computations, section 5.2); A^T A, whose condition is
    squared, is never formed. Not scaled against overflow: entries should be of about unit size. Returns a mask: whether
    each matrix has rank m, without which its basis is finite but means nothing. scale: (m, LANES), for the work."""
    full_rank = fill(0.0) == 0.0
    for k in range(m):
        length2 = _dot(A, 9 * k, A, 9 * k, 9)
        for earlier in range(k):  # the reflections so far
            _reflect(A, 10 * earlier, A, 9 * k + earlier, 9 - earlier, load(scale, earlier))
        head = 10 * k
        left = _dot(A, head, A, head, 9 - k)
        full_rank &= left > RANK_TOLERANCE2 * length2
        first = load(A, head)
        shift = copysign(sqrt(where(left > 0.0, left, 1.0)), first)
        store(A, head, first + shift)
        store(scale, k, 1.0 / (shift * (first + shift)))
    for j in range(9 - m):
        for c in range(9):
            store(B, 9 * j + c, fill(1.0 if c == m + j else 0.0))
        for k in range(m - 1, -1, -1):
            _reflect(A, 10 * k, B, 9 * j + k, 9 - k, load(scale, k))
    return full_rank


@inner
def _dot(A: Array, a: int, B: Array, b: int, n: int) -> Any:
    """Products of n components from A[a] and B[b] on, summed."""
    total = fill(0.0)
    for c in range(n):
        total += load(A, a + c) * load(B, b + c)
    return total


@inner
def _reflect(A: Array, a: int, B: Array, b: int, n: int, scale: Any) -> None:
    """Reflects the n components of B from b on across the plane normal to those of A from a on."""
    along = _dot(A, a, B, b, n) * scale
    for c in range(n):
        store(B, b + c, load(B, b + c) - along * load(A, a + c))
