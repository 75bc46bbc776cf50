"""`sampson_objective` for models on the matches of one pair, compiled; float64, LANES matches at a time."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, F8x1, F8x2, F8x3
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.lanes import LANES, added, fill, load, sqrt, store, where
from fmtorch.compiling.scratch import matrix
from fmtorch.geometry.arithmetic_kernels import logarithm_1p
from fmtorch.geometry.magsac import LOSS_TABLE

TINY = 1e-30  # as in `residuals`
HUBER, CAUCHY, GEMAN_MCCLURE, TRUNCATED, MAGSAC = 0, 1, 2, 3, 4  # losses
LOSSES = {"huber": HUBER, "cauchy": CAUCHY, "geman_mcclure": GEMAN_MCCLURE, "truncated": TRUNCATED, "magsac": MAGSAC}
NO_TABLE = np.empty((2, 0))
MATCH = 6  # rows of LANES matches: x0, y0, x1, y1, their weights, squared scales


def loss_table(loss: str) -> Array:
    """What `Weighted.table` is for a loss of this name."""
    return LOSS_TABLE if loss == "magsac" else NO_TABLE


class Weighted(NamedTuple):
    """Matches and a robust loss of their errors.

    points: (4, n). weight: (n,), what each counts. s2: (n,), squared scales of the loss, a code. table: (2, t + 2), of
    the loss MAGSAC, its weight at the ends of t intervals of r^2 / s^2 and beyond, and the weight's integral up to
    there; of others it is not read.
    """

    points: F8x2
    weight: F8x1
    s2: F8x1
    loss: int
    table: F8x2


@kernel
def evaluate(F: F8x2, weighted: Weighted, derivatives: bool, products: F8x3, cost: F8x1) -> None:
    """Robust weighted cost (k,) of models (k, 9) by Sampson distances; with derivatives also products (k, 10, 10)."""
    matches, loss, table = in_rows(weighted.points, weighted.weight, weighted.s2), weighted.loss, weighted.table
    sums, J, scaled, work = matrix(55, LANES), matrix(10, LANES), matrix(10, LANES), matrix(3, LANES)
    for k in range(len(F)):
        costs = fill(0.0)
        for q in range(55 if derivatives else 0):
            store(sums, q, costs)
        for row in range(0, len(matches), MATCH):
            inverse, r2 = linearise(F[k], matches, row, J)
            share, slope = robust(r2, load(matches, row + 5), loss, table, work)
            costs += share * load(matches, row + 4)
            if derivatives:
                add_products(J, inverse * (load(matches, row + 4) * slope), scaled, sums)
        cost[k] = added(costs)
        q = 0
        for r in range(10 if derivatives else 0):
            for c in range(r + 1):
                total = added(load(sums, q))
                products[k, r, c], products[k, c, r] = total, total
                q += 1


@inner
def in_rows(points: Array, weight: Array, s2: Array) -> Array:
    """Matches (n,), LANES in MATCH rows each; those that fill the last ones have no weight."""
    n = len(weight)
    count = (n + LANES - 1) // LANES
    rows = np.zeros((MATCH * count, LANES))
    for first in range(0, n, LANES):
        row = first // LANES * MATCH
        for i in range(LANES):
            rows[row + 5, i] = 1.0
        for i in range(min(LANES, n - first)):
            for k in range(4):
                rows[row + k, i] = points[k, first + i]
            rows[row + 4, i], rows[row + 5, i] = weight[first + i], s2[first + i]
    return rows


@inner
def linearise(f: Array, matches: Array, row: int, J: Array) -> tuple[Any, Any]:
    """Jacobian and residual of LANES matches -> J (10, LANES); inverse squared slopes, squared Sampson distances."""
    x0, y0, x1, y1 = load(matches, row), load(matches, row + 1), load(matches, row + 2), load(matches, row + 3)
    a0, b0 = f[0] * x0 + f[1] * y0 + f[2], f[3] * x0 + f[4] * y0 + f[5]
    a1, b1 = f[0] * x1 + f[3] * y1 + f[6], f[1] * x1 + f[4] * y1 + f[7]
    e = f[6] * x0 + f[7] * y0 + f[8] + a0 * x1 + b0 * y1
    slope = a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1
    inverse = 1.0 / where(slope > TINY, slope, TINY)
    c = e * inverse
    u, v, p, q = x1 - c * a0, y1 - c * b0, -c * a1, -c * b1
    store(J, 0, u * x0 + x1 * p)
    store(J, 1, u * y0 + x1 * q)
    store(J, 2, u)
    store(J, 3, v * x0 + y1 * p)
    store(J, 4, v * y0 + y1 * q)
    store(J, 5, v)
    store(J, 6, x0 + p)
    store(J, 7, y0 + q)
    store(J, 8, fill(1.0))
    store(J, 9, e)
    return inverse, e * c


@inner
def robust(r2: Any, s2: Any, loss: int, table: Array, work: Array) -> tuple[Any, Any]:
    """The losses of squared residuals, and their derivatives by these. work: (3, LANES)."""
    if loss == TRUNCATED:
        value, slope = where(r2 <= s2, r2, s2), where(r2 <= s2, fill(1.0), 0.0)
    elif loss == GEMAN_MCCLURE:
        share = s2 / (s2 + r2)
        value, slope = r2 * share, share * share
    elif loss == HUBER:
        far = where(r2 > s2, r2, s2)
        value, slope = where(r2 <= s2, r2, 2.0 * sqrt(s2 * far) - s2), sqrt(s2 / far)
    elif loss == CAUCHY:
        store(work, 0, r2 / s2)
        for i in range(LANES):
            work[0, i] = logarithm_1p(work[0, i])
        value, slope = s2 * load(work, 0), s2 / (s2 + r2)
    else:
        store(work, 0, r2 / s2)
        _tabulated(table, work)
        value, slope = s2 * load(work, 1), load(work, 2)
    # A residual that is not a number must not pass for a small loss.
    return where(r2 == r2, value, math.nan), slope


@inner
def _tabulated(table: Array, work: Array) -> None:
    """Integral and value of the table at r^2 / s^2, in row 0 of work (3, LANES) -> its rows 1 and 2."""
    entries = table.shape[1] - 2
    for i in range(LANES):
        position = work[0, i] * entries
        position = position if position < entries else float(entries)
        interval = min(max(np.int64(position), 0), entries)
        share, begin = position - interval, table[0, interval]
        rise = table[0, interval + 1] - begin
        work[1, i] = table[1, interval] + (begin + share * rise / 2) * share / entries
        work[2, i] = begin + share * rise


@inner
def add_products(J: Array, factor: Any, weighted: Array, sums: Array) -> None:
    """Adds the lower triangle of the weighted products of Jacobian and residual, row by row."""
    for r in range(10):
        store(weighted, r, load(J, r) * factor)
    q = 0
    for r in range(10):
        of_row = load(J, r)
        for c in range(r + 1):
            store(sums, q, load(sums, q) + of_row * load(weighted, c))
            q += 1
