"""`sampson_objective` for models on the matches of one pair, compiled; float64, with WIDTH partial sums."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.kernels import inner, kernel

Array = NDArray[Any]
WIDTH = 32  # partial sums over the matches: part of the last bits
TINY = 1e-30  # as in `residuals`
HUBER, CAUCHY, GEMAN_MCCLURE, TRUNCATED, MAGSAC = 0, 1, 2, 3, 4  # losses
LOSSES = {"huber": HUBER, "cauchy": CAUCHY, "geman_mcclure": GEMAN_MCCLURE, "truncated": TRUNCATED, "magsac": MAGSAC}
RESIDUAL, INVERSE, SQUARED, LOSS, COUNT, SCALE, POINTS, ROWS = 9, 10, 11, 12, 13, 14, 15, 19  # of a block, after J


@kernel("f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], i8, f8[:, ::1], b1, f8[:, :, ::1], f8[::1]")
def evaluate(
    F: Array, points: Array, weight: Array, s2: Array, loss: int, table: Array, derivatives: bool, products: Array,
    cost: Array,
) -> None:  # fmt: skip
    """`SampsonObjective` of models (k, 9), points (4, n), weights (n,) -> products (k, 10, 10), if wanted; cost (k,).

    s2: (n,), squared scales of the loss, a code. table: (2, t + 2), of the loss MAGSAC, its weight at the ends of t
    intervals of r^2 / s^2 and beyond, and the weight's integral up to there.
    """
    sums, block, weighted = np.empty((55, WIDTH)), np.empty((ROWS, WIDTH)), np.empty((10, WIDTH))
    costs = np.empty(WIDTH)
    for k in range(len(F)):
        for i in range(WIDTH):
            costs[i] = 0.0
        for q in range(55 if derivatives else 0):
            for i in range(WIDTH):
                sums[q, i] = 0.0
        for first in range(0, len(weight), WIDTH):
            linearise(F[k], points, weight, s2, first, block)
            robust(block, loss, table)
            for i in range(WIDTH):
                costs[i] += block[LOSS, i] * block[COUNT, i]
            if derivatives:
                _add_products(block, weighted, sums)
        cost[k] = 0.0
        for i in range(WIDTH):
            cost[k] += costs[i]
        q = 0
        for r in range(10 if derivatives else 0):
            for c in range(r + 1):
                total = 0.0
                for i in range(WIDTH):
                    total += sums[q, i]
                products[k, r, c], products[k, c, r] = total, total
                q += 1


@inner
def linearise(f: Array, points: Array, weight: Array, s2: Array, first: int, block: Array) -> None:
    """Jacobian, residual and what belongs to them of the matches from `first` on; weight zero where there are none."""
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    J0, J1, J2, J3, J4, J5, J6, J7, J8 = (
        block[0], block[1], block[2], block[3], block[4], block[5], block[6], block[7], block[8],
    )  # fmt: skip
    E, V, R, W, S = block[RESIDUAL], block[INVERSE], block[SQUARED], block[COUNT], block[SCALE]
    X0, Y0, X1, Y1 = block[POINTS], block[POINTS + 1], block[POINTS + 2], block[POINTS + 3]
    count = min(WIDTH, len(weight) - first)
    for i in range(count):
        X0[i], Y0[i] = points[0, first + i], points[1, first + i]
        X1[i], Y1[i] = points[2, first + i], points[3, first + i]
        W[i], S[i] = weight[first + i], s2[first + i]
    for i in range(count, WIDTH):
        X0[i], Y0[i], X1[i], Y1[i], W[i], S[i] = 0.0, 0.0, 0.0, 0.0, 0.0, 1.0
    for i in range(WIDTH):
        x0, y0, x1, y1 = X0[i], Y0[i], X1[i], Y1[i]
        a0, b0 = f0 * x0 + f1 * y0 + f2, f3 * x0 + f4 * y0 + f5
        a1, b1 = f0 * x1 + f3 * y1 + f6, f1 * x1 + f4 * y1 + f7
        e = f6 * x0 + f7 * y0 + f8 + a0 * x1 + b0 * y1
        slope = a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1
        inverse = 1.0 / (slope if slope > TINY else TINY)
        c = e * inverse
        E[i], V[i], R[i] = e, inverse, e * c
        u, v, p, q = x1 - c * a0, y1 - c * b0, -c * a1, -c * b1
        J0[i], J1[i], J2[i] = u * x0 + x1 * p, u * y0 + x1 * q, u
        J3[i], J4[i], J5[i] = v * x0 + y1 * p, v * y0 + y1 * q, v
        J6[i], J7[i], J8[i] = x0 + p, y0 + q, 1.0


@inner
def robust(block: Array, loss: int, table: Array) -> None:
    """The losses; and what the products of derivatives are weighted with, in place of the inverse slopes."""
    R, S, L, W, V = block[SQUARED], block[SCALE], block[LOSS], block[COUNT], block[INVERSE]
    if loss == TRUNCATED:
        for i in range(WIDTH):
            L[i] = R[i] if R[i] <= S[i] else S[i]
            V[i] *= W[i] if R[i] <= S[i] else 0.0
    elif loss == GEMAN_MCCLURE:
        for i in range(WIDTH):
            share = S[i] / (S[i] + R[i])
            L[i] = R[i] * share
            V[i] *= W[i] * (share * share)
    elif loss == HUBER:
        for i in range(WIDTH):
            far = R[i] if R[i] > S[i] else S[i]
            L[i] = R[i] if R[i] <= S[i] else 2 * math.sqrt(S[i] * far) - S[i]
            V[i] *= W[i] * math.sqrt(S[i] / far)
    elif loss == CAUCHY:
        for i in range(WIDTH):
            L[i] = S[i] * math.log1p(R[i] / S[i])
            V[i] *= W[i] * (S[i] / (S[i] + R[i]))
    else:
        entries = table.shape[1] - 2
        for i in range(WIDTH):
            position = R[i] / S[i] * entries
            position = position if position < entries else float(entries)
            interval = min(max(np.int64(position), 0), entries)
            share, begin = position - interval, table[0, interval]
            rise = table[0, interval + 1] - begin
            L[i] = S[i] * (table[1, interval] + (begin + share * rise / 2) * share / entries)
            V[i] *= W[i] * (begin + share * rise)
    # A residual that is not a number must not pass for a small loss.
    for i in range(WIDTH):
        L[i] = L[i] if R[i] == R[i] else math.nan


@inner
def _add_products(block: Array, weighted: Array, sums: Array) -> None:
    """Adds the lower triangle of the products of Jacobian and residual, row by row."""
    for r in range(10):
        for i in range(WIDTH):
            weighted[r, i] = block[r, i] * block[INVERSE, i]
    q = 0
    for r in range(10):
        for c in range(r + 1):
            for i in range(WIDTH):
                sums[q, i] += block[r, i] * weighted[c, i]
            q += 1
