"""Which models and matches go on, compiled: the best of a round and of a search; matches near these, and the first of
a random order. Ties go to the earlier.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.random_kernels import random_bits, stream_state
from fmtorch.geometry.order_kernels import smallest_but, sort_by
from fmtorch.geometry.rank2_kernels import assign

Array = NDArray[Any]
TINY = float(np.finfo(np.float64).tiny)
LAST_WORD = (1 << 63) - 1


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


@kernel("f4[:, ::1], i8[::1], f8[::1], i8, f4[:, ::1], f8[::1]", brief=True)
def merge(F: Array, which: Array, score: Array, filled: int, pool: Array, pool_score: Array) -> int:
    """Models F[which] (m, 9) with scores (k,) among the best so far -> pool (p, 9); how many there are.

    filled: places of the pool in use, which are sorted, best first. A score that is not finite is that of no model.
    """
    for k in range(len(which)):
        if not math.isfinite(score[k]) or (filled == len(pool_score) and not score[k] > pool_score[filled - 1]):
            continue
        place = min(filled, len(pool_score) - 1)
        while place > 0 and pool_score[place - 1] < score[k]:
            pool_score[place] = pool_score[place - 1]
            assign(pool[place], pool[place - 1])
            place -= 1
        pool_score[place] = score[k]
        assign(pool[place], F[which[k]])
        filled = min(filled + 1, len(pool_score))
    return filled


@kernel("f4[:, ::1], f4[:, ::1], f4, i8, i8, i8[::1]")
def near(F: Array, points: Array, limit: Any, mixed_seed: int, key: int, out: Array) -> int:
    """As `shuffled`, of those of the points (4, n) within a squared Sampson distance of one of the models (k, 9).

    Nothing is near a model of zeros.
    """
    x0, y0, x1, y1 = points[0], points[1], points[2], points[3]
    wanted = np.zeros(points.shape[1], np.bool_)
    for k in range(len(F)):
        f0, f1, f2, f3, f4 = F[k, 0], F[k, 1], F[k, 2], F[k, 3], F[k, 4]
        f5, f6, f7, f8 = F[k, 5], F[k, 6], F[k, 7], F[k, 8]
        zero = f0 == 0 and f1 == 0 and f2 == 0 and f3 == 0 and f4 == 0 and f5 == 0 and f6 == 0 and f7 == 0 and f8 == 0
        for i in range(0 if zero else len(wanted)):
            a0, b0 = f0 * x0[i] + f1 * y0[i] + f2, f3 * x0[i] + f4 * y0[i] + f5
            e = f6 * x0[i] + f7 * y0[i] + f8 + a0 * x1[i] + b0 * y1[i]
            a1, b1 = f0 * x1[i] + f3 * y1[i] + f6, f1 * x1[i] + f4 * y1[i] + f7
            wanted[i] |= e * e <= limit * (a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1)
    index, count = np.empty(len(wanted), np.int64), 0
    for i in range(len(wanted)):
        index[count] = i
        count += wanted[i]
    return _first_shuffled(index[:count], mixed_seed, key, out)


@kernel("i8, i8, i8, i8[::1]", brief=True)
def shuffled(count: int, mixed_seed: int, key: int, out: Array) -> int:
    """The first of so many matches in the order of `pool.shuffled` -> out (k,); how many they are.

    mixed_seed: of the seed and the stream.
    """
    index = np.empty(count, np.int64)
    for i in range(count):
        index[i] = i
    return _first_shuffled(index, mixed_seed, key, out)


@kernel("f8[::1], i8, i8, i8[::1]", brief=True)
def drawn_by_prior(prior: Array, mixed_seed: int, key: int, out: Array) -> None:
    """The first matches in the order of `pool.by_priority`, of priors (n,) -> out (k,), ascending."""
    priority, state = np.empty(len(prior)), stream_state(mixed_seed, key)
    for i in range(len(prior)):
        priority[i] = prior[i] / (np.float64(random_bits(state, i)) + 1)
    best(priority, out)


@inner
def _first_shuffled(index: Array, mixed_seed: int, key: int, out: Array) -> int:
    """The first ones of the matches (m,), ascending, in a random order -> out (k,); how many they are."""
    m, kept, state = len(index), 0, stream_state(mixed_seed, key)
    word = np.empty(m, np.int64)
    for i in range(m):
        word[i] = np.int64(random_bits(state, index[i]))
    last = smallest_but(word.copy(), 0, m, len(out) - 1) if 0 < len(out) < m else np.int64(LAST_WORD)
    for i in range(m):
        if word[i] <= last:
            word[kept], index[kept] = word[i], index[i]
            kept += 1
    sort_by(word[:kept], index[:kept])
    kept = min(kept, len(out))
    for i in range(kept):
        out[i] = index[i]
    return kept


@kernel("f8[::1], f8[:, ::1], f8, f8[::1]", brief=True)
def residuals_squared(F: Array, points: Array, factor: float, out: Array) -> None:
    """Squared Sampson distances of points (4, n) to one model (9,), times a factor, in float64 -> out (n,)."""
    x0, y0, x1, y1 = points[0], points[1], points[2], points[3]
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = F[0], F[1], F[2], F[3], F[4], F[5], F[6], F[7], F[8]
    for i in range(len(out)):
        a0, b0 = f0 * x0[i] + f1 * y0[i] + f2, f3 * x0[i] + f4 * y0[i] + f5
        e = f6 * x0[i] + f7 * y0[i] + f8 + a0 * x1[i] + b0 * y1[i]
        a1, b1 = f0 * x1[i] + f3 * y1[i] + f6, f1 * x1[i] + f4 * y1[i] + f7
        slope = a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1
        out[i] = e * e / (slope if slope > TINY else TINY) * factor


@kernel("f8[::1], f8[:, ::1], f8, f8, b1[::1]", brief=True)
def within(F: Array, points: Array, factor: float, limit: float, out: Array) -> None:
    """Which matches' `residuals_squared` are within a limit -> out (n,)."""
    r2 = np.empty(len(out))
    residuals_squared(F, points, factor, r2)
    for i in range(len(out)):
        out[i] = r2[i] <= limit


@kernel("f8[::1], f8[:, ::1], f8, f8, i8[::1]", brief=True)
def share_within(F: Array, points: Array, factor: float, limit: float, weight: Array) -> float:
    """The share of the matches' weights (n,) of those whose `residuals_squared` are within a limit."""
    r2, total, within = np.empty(len(weight)), np.int64(0), np.int64(0)
    residuals_squared(F, points, factor, r2)
    for i in range(len(weight)):
        total += weight[i]
        within += weight[i] if r2[i] <= limit else 0
    return within / total
