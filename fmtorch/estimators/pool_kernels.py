"""Which models go on, compiled: the best of a round and of a search, and matches near these. Ties go to the earlier."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.geometry.order_kernels import smallest_but
from fmtorch.geometry.rank2_kernels import assign
from fmtorch.kernels import kernel

Array = NDArray[Any]
TINY = float(np.finfo(np.float64).tiny)


@kernel("f8[::1], i8[::1]", brief=True)
def best(score: Array, out: Array) -> None:
    """The indices of the k best of m >= k scores, in ascending order -> out (k,)."""
    m, k = len(score), len(out)
    least, better = smallest_but(score.copy(), 0, m, m - k), 0
    for i in range(m):
        better += score[i] > least
    equal, place = k - better, 0
    for i in range(m):
        if score[i] > least or (score[i] == least and equal > 0):
            equal -= score[i] == least
            out[place] = i
            place += 1


@kernel("f4[:, ::1], i8[::1], f8[::1], i8[::1], i8, f4[:, ::1], f8[::1], i8[::1]", brief=True)
def merge(
    F: Array, which: Array, score: Array, draw: Array, filled: int, pool: Array, pool_score: Array, pool_draw: Array
) -> int:  # fmt: skip
    """Models F[which] (m, 9) with scores (k,) of draws (m,) among the best so far -> pool (p, 9); how many there are.

    filled: places of the pool in use, which are sorted, best first.
    """
    for k in range(len(which)):
        if filled == len(pool_score) and not score[k] > pool_score[filled - 1]:
            continue
        place = min(filled, len(pool_score) - 1)
        while place > 0 and pool_score[place - 1] < score[k]:
            pool_score[place] = pool_score[place - 1]
            pool_draw[place] = pool_draw[place - 1]
            assign(pool[place], pool[place - 1])
            place -= 1
        pool_score[place] = score[k]
        pool_draw[place] = draw[which[k]]
        assign(pool[place], F[which[k]])
        filled = min(filled + 1, len(pool_score))
    return filled


@kernel("f4[:, ::1], f4[:, ::1], f4, b1[::1]")
def near(F: Array, points: Array, limit: Any, out: Array) -> None:
    """Which of the points (4, n) are within a squared Sampson distance of one of the models (k, 9) -> out (n,).

    Nothing is near a model of zeros.
    """
    x0, y0, x1, y1 = points[0], points[1], points[2], points[3]
    out[:] = False
    for k in range(len(F)):
        f0, f1, f2, f3, f4 = F[k, 0], F[k, 1], F[k, 2], F[k, 3], F[k, 4]
        f5, f6, f7, f8 = F[k, 5], F[k, 6], F[k, 7], F[k, 8]
        zero = f0 == 0 and f1 == 0 and f2 == 0 and f3 == 0 and f4 == 0 and f5 == 0 and f6 == 0 and f7 == 0 and f8 == 0
        for i in range(0 if zero else len(out)):
            a0, b0 = f0 * x0[i] + f1 * y0[i] + f2, f3 * x0[i] + f4 * y0[i] + f5
            e = f6 * x0[i] + f7 * y0[i] + f8 + a0 * x1[i] + b0 * y1[i]
            a1, b1 = f0 * x1[i] + f3 * y1[i] + f6, f1 * x1[i] + f4 * y1[i] + f7
            out[i] |= e * e <= limit * (a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1)


@kernel("f8[::1], f8[:, ::1], f8[::1]", brief=True)
def residuals_squared(F: Array, points: Array, out: Array) -> None:
    """Squared Sampson distances of points (4, n) to one model (9,) in float64 -> out (n,)."""
    x0, y0, x1, y1 = points[0], points[1], points[2], points[3]
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = F[0], F[1], F[2], F[3], F[4], F[5], F[6], F[7], F[8]
    for i in range(len(out)):
        a0, b0 = f0 * x0[i] + f1 * y0[i] + f2, f3 * x0[i] + f4 * y0[i] + f5
        e = f6 * x0[i] + f7 * y0[i] + f8 + a0 * x1[i] + b0 * y1[i]
        a1, b1 = f0 * x1[i] + f3 * y1[i] + f6, f1 * x1[i] + f4 * y1[i] + f7
        slope = a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1
        out[i] = e * e / (slope if slope > TINY else TINY)
