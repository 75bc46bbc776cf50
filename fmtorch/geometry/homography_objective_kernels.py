"""The Sampson error of homographies, and its Levenberg-Marquardt on the sphere of their nine entries.

The two equations of a match, ``e = (X - u W, Y - v W)`` with ``(X, Y, W) = H (x, y, 1)`` and (u, v) its point in image
1, have the Jacobian J (2, 4) by x, y, u, v; the distance is that of the least correction of the four that makes them
hold to first order, ``r^2 = e^T (J J^T)^-1 e`` (Hartley & Zisserman 2004, section 4.2.6). Both its numerator and its
determinant are sums of squares here: nothing cancels. A match whose W is not positive is infinitely far: it would lie
on the other side of the plane's horizon. In a sum that is minimised it is `BEHIND` far: one wrong match there must not
make the cost of an unbounded loss infinite, of which no step is an improvement.

By a change of H, ``dr^2 = 2 l^T (de + dJ d)`` with the multipliers ``l = (J J^T)^-1 e`` and the correction
``d = -J^T l`` of the four coordinates. G, the derivative (2, 9) of the equations corrected by d, gives the gradient
``G^T l`` exactly and the Gauss-Newton matrix ``G^T (J J^T)^-1 G``. The error does not depend on the scale of H, so a
step is orthogonal to it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, F8x1, F8x2, F8x3
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.lanes import LANES, added, fill, load, sqrt, store, where
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.geometry import residual_kernels as rows_of
from fmtorch.geometry.levenberg_marquardt_kernels import Schedule, levenberg_marquardt
from fmtorch.geometry.rank2_kernels import assign, assign_rows, unit
from fmtorch.geometry.rank2_manifold_kernels import eliminate
from fmtorch.geometry.residual_kernels import TINY32, Residual
from fmtorch.geometry.sampson_objective_kernels import MATCH, TINY, Weighted, add_products, in_rows, robust

MIN_DAMPING, MAX_DAMPING = 1e-12, 1e6
BEHIND = 1e12  # squared distance of a match behind the horizon in the units of the points, which extend to about one
INFINITE, ZERO = np.float32(math.inf), np.float32(0)
load32 = rows_of.load


@inner
def _of_row(h: Array, rows: Array, row: int) -> Any:
    x, y, u, v = load32(rows, row), load32(rows, row + 1), load32(rows, row + 2), load32(rows, row + 3)
    w = h[6] * x + h[7] * y + h[8]
    e, f = h[0] * x + h[1] * y + h[2] - u * w, h[3] * x + h[4] * y + h[5] - v * w
    a, b, c, d = h[0] - u * h[6], h[1] - u * h[7], h[3] - v * h[6], h[4] - v * h[7]
    p, q, area, w2 = c * e - a * f, d * e - b * f, a * d - b * c, w * w
    determinant = area * area + w2 * (a * a + b * b + c * c + d * d + w2)
    r2 = (w2 * (e * e + f * f) + p * p + q * q) / where(determinant > TINY32, determinant, TINY32)
    return where(w > ZERO, r2 * load32(rows, row + 4), INFINITE)


@inner
def _of_match(h: Array, x: Any, y: Any, u: Any, v: Any) -> Any:
    w = h[6] * x + h[7] * y + h[8]
    e, f = h[0] * x + h[1] * y + h[2] - u * w, h[3] * x + h[4] * y + h[5] - v * w
    a, b, c, d = h[0] - u * h[6], h[1] - u * h[7], h[3] - v * h[6], h[4] - v * h[7]
    p, q, area, w2 = c * e - a * f, d * e - b * f, a * d - b * c, w * w
    determinant = area * area + w2 * (a * a + b * b + c * c + d * d + w2)
    return (w2 * (e * e + f * f) + p * p + q * q) / determinant if w > 0 else w - w + math.inf


@inner
def _within(h: Array, x: Any, y: Any, u: Any, v: Any, limit: Any) -> Any:
    return _of_match(h, x, y, u, v) <= limit


HOMOGRAPHY = Residual("homography", _of_row, _of_match, _within)


class _State(NamedTuple):
    """Models of unit norm (k, 9), and the normal equations (k, 10, 10) and costs (k,) there."""

    H: Array
    products: Array
    cost: Array


class _Data(NamedTuple):
    """The matches; tolerance: of the schedule."""

    matches: Weighted
    tolerance: float


@kernel
def evaluate_homographies(H: F8x2, weighted: Weighted, derivatives: bool, products: F8x3, cost: F8x1) -> None:
    """The robust error of models (k, 9) -> cost (k,); the normal equations -> products (k, 10, 10), if wanted."""
    rows, loss, table = in_rows(weighted.points, weighted.weight, weighted.s2), weighted.loss, weighted.table
    sums, G, first, second = matrix(55, LANES), matrix(18, LANES), matrix(10, LANES), matrix(10, LANES)
    scaled, work = matrix(10, LANES), matrix(3, LANES)
    for k in range(len(H)):
        costs = fill(0.0)
        for q in range(55 if derivatives else 0):
            store(sums, q, costs)
        for row in range(0, len(rows), MATCH):
            r2 = _linearise(H[k], rows, row, G, first, second)
            share, slope = robust(r2, load(rows, row + 5), loss, table, work)
            weight = load(rows, row + 4)
            costs += where(weight > 0.0, share * weight, 0.0)
            if derivatives:
                factor = where(weight > 0.0, weight * slope, 0.0)
                add_products(first, factor, scaled, sums)
                add_products(second, factor, scaled, sums)
        cost[k] = added(costs)
        q = 0
        for r in range(10 if derivatives else 0):
            for c in range(r + 1):
                total = added(load(sums, q))
                products[k, r, c], products[k, c, r] = total, total
                q += 1


@inner
def _linearise(h: Array, rows: Array, row: int, G: Array, first: Array, second: Array) -> Any:
    """Squared distances of LANES matches; the two whitened rows of G and e -> first, second (10, LANES).

    With ``(J J^T)^-1 = R^T R``, R upper triangular, these are R G and R e. G: (18, LANES), for the work.
    """
    x, y, u, v = load(rows, row), load(rows, row + 1), load(rows, row + 2), load(rows, row + 3)
    w = h[6] * x + h[7] * y + h[8]
    front, behind = w > 0.0, where(w <= 0.0, fill(BEHIND), math.nan)
    w = where(front, w, 1.0)
    e, f = h[0] * x + h[1] * y + h[2] - u * w, h[3] * x + h[4] * y + h[5] - v * w
    a, b, c, d = h[0] - u * h[6], h[1] - u * h[7], h[3] - v * h[6], h[4] - v * h[7]
    area, w2 = a * d - b * c, w * w
    determinant = area * area + w2 * (a * a + b * b + c * c + d * d + w2)
    inverse = 1.0 / where(determinant > TINY, determinant, TINY)
    i00, i01, i11 = (c * c + d * d + w2) * inverse, (a * c + b * d) * inverse, (a * a + b * b + w2) * inverse
    l0, l1 = i00 * e - i01 * f, i11 * f - i01 * e
    dx, dy, du, dv = 0.0 - (a * l0 + c * l1), 0.0 - (b * l0 + d * l1), w * l0, w * l1
    r00 = sqrt(i00)
    r01 = (0.0 - i01) / r00
    r11 = sqrt(where(i11 - r01 * r01 > TINY, i11 - r01 * r01, TINY))
    X, Y = x + dx, y + dy
    store(G, 0, X)
    store(G, 1, Y)
    store(G, 2, fill(1.0))
    store(G, 6, 0.0 - (u * X + x * du))
    store(G, 7, 0.0 - (u * Y + y * du))
    store(G, 8, 0.0 - (u + du))
    store(G, 15, 0.0 - (v * X + x * dv))
    store(G, 16, 0.0 - (v * Y + y * dv))
    store(G, 17, 0.0 - (v + dv))
    for q in range(3):
        g = load(G, q)
        store(first, q, r00 * g)
        store(first, 3 + q, r01 * g)
        store(second, q, fill(0.0))
        store(second, 3 + q, r11 * g)
        store(first, 6 + q, r00 * load(G, 6 + q) + r01 * load(G, 15 + q))
        store(second, 6 + q, r11 * load(G, 15 + q))
    store(first, 9, r00 * e + r01 * f)
    store(second, 9, r11 * f)
    return where(front, e * l0 + f * l1, behind)


@kernel
def refine_homographies(H: F8x2, matches: Weighted, schedule: Schedule, out: F8x2, cost: F8x1) -> None:
    """Models (k, 9) refined -> out (k, 9), of unit norm, cost (k,); what cannot be is not finite, nor its cost."""
    k = len(H)
    state = _State(out, np.empty((k, 10, 10)), cost)
    trial = _State(matrix(k, 9), np.empty((k, 10, 10)), vector(k))
    for i in range(k):
        assign(out[i], H[i])
        unit(out[i])
    damping = np.full(k, schedule.damping)
    _minimise(_Data(matches, schedule.tolerance), state, trial, damping, schedule.iterations, schedule.tolerance > 0)


@kernel(holds_gil=True)
def step_of_homography(H: F8x1, matches: Weighted, damping: float, out: F8x1) -> None:
    """One damped Gauss-Newton step of a model (9,) -> out (9,), of unit norm."""
    at, products, cost, Q = matrix(1, 9), np.empty((1, 10, 10)), vector(1), matrix(18, LANES)
    assign(at[0], H)
    unit(at[0])
    evaluate_homographies(at, matches, True, products, cost)
    _stepped(products[0], at[0], damping, Q, out)


@inner
def _evaluate(state: _State, data: _Data, derivatives: bool) -> None:
    evaluate_homographies(state.H, data.matches, derivatives, state.products, state.cost)


@inner
def _step(state: _State, damping: Array, trial: _State) -> None:
    Q = matrix(18, LANES)
    for k in range(len(damping)):
        _stepped(state.products[k], state.H[k], damping[k], Q, trial.H[k])


@inner
def _stepped(products: Array, h: Array, damping: float, Q: Array, out: Array) -> None:
    """A damped step of h (9,) on the sphere -> out (9,)."""
    _system(products, h, damping, Q)
    for r in range(9):
        Q[2 * r + 1, 9 - LANES] = -products[r, 9]
    eliminate(Q, 9)
    for i in range(9):
        out[i] = h[i] + Q[2 * i + 1, 9 - LANES]
    unit(out)


@inner
def _system(products: Array, h: Array, damping: float, Q: Array) -> None:
    """The damped normal equations of h (9,) -> Q, (9, 10) in two rows of LANES each, without right side."""
    curvature = 0.0
    for i in range(9):
        curvature = max(curvature, products[i, i])
    for r in range(9):
        for c in range(9):
            Q[2 * r + c // LANES, c % LANES] = products[r, c] + curvature * h[r] * h[c]
        Q[2 * r + r // LANES, r % LANES] += curvature * damping


@inner
def _accept(state: _State, trial: _State, damping: Array, done: Array, data: _Data) -> bool:
    everything = True
    for k in range(len(damping)):
        better = trial.cost[k] < state.cost[k] and not done[k]
        damping[k] = min(max(damping[k] / 10 if better else damping[k] * 10, MIN_DAMPING), MAX_DAMPING)
        if better:
            done[k] |= data.tolerance > 0 and state.cost[k] - trial.cost[k] <= data.tolerance * state.cost[k]
            state.cost[k] = trial.cost[k]
            assign(state.H[k], trial.H[k])
            assign_rows(state.products[k], trial.products[k])
        everything = everything and done[k]
    return everything


_minimise = levenberg_marquardt(_evaluate, _step, _accept)
