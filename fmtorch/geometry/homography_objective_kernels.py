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

from typing import Any, NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, F8x1, F8x2, F8x3
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.lanes import LANES, added, fill, load, store, where
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.geometry.levenberg_marquardt_kernels import Problem, Schedule, accepting, levenberg_marquardt
from fmtorch.geometry.rank2_kernels import assign, assign_rows, unit
from fmtorch.geometry.rank2_manifold_kernels import eliminate
from fmtorch.geometry.sampson_objective_kernels import MATCH, TINY, Weighted, in_rows, robust

BEHIND = 1e4  # squared distance of a match behind the horizon in the units of the points, which extend to about one
SUMS = 52  # over the matches, of the normal equations


class _State(NamedTuple):
    """Models of unit norm (k, 9), and the normal equations (k, 10, 10) and costs (k,) there."""

    H: Array
    products: Array
    cost: Array


@kernel
def evaluate_homographies(H: F8x2, weighted: Weighted, derivatives: bool, products: F8x3, cost: F8x1) -> None:
    """The robust error of models (k, 9) -> cost (k,); the normal equations -> products (k, 10, 10), if wanted.

    These are ``G^T (J J^T)^-1 G``, the gradient and r^2, each times the weights of matches and loss, summed.
    """
    rows, loss, table = in_rows(weighted.points, weighted.weight, weighted.s2), weighted.loss, weighted.table
    sums, factors, work = matrix(SUMS, LANES), matrix(14, LANES), matrix(3, LANES)
    for k in range(len(H)):
        costs = fill(0.0)
        for q in range(SUMS if derivatives else 0):
            store(sums, q, costs)
        for row in range(0, len(rows), MATCH):
            r2 = _linearise(H[k], rows, row, derivatives, factors)
            share, slope = robust(r2, load(rows, row + 5), loss, table, work)
            weight = load(rows, row + 4)
            costs += where(weight > 0.0, share * weight, 0.0)
            if derivatives:
                counted = where((weight > 0.0) & (r2 < BEHIND), weight * slope, 0.0)
                _add_products(factors, counted, sums)
                store(sums, SUMS - 1, load(sums, SUMS - 1) + counted * r2)
        cost[k] = added(costs)
        if derivatives:
            _assemble(sums, products[k])


@inner
def _linearise(h: Array, rows: Array, row: int, derivatives: bool, factors: Array) -> Any:
    """Squared distances of LANES matches; what their normal equations are made of -> factors (14, LANES), if wanted.

    G is (t, 0, c) and, in its second row, (0, t, d), in blocks of three entries: t, c, d, then the three entries of
    ``(J J^T)^-1`` and the two of l.
    """
    x, y, u, v = load(rows, row), load(rows, row + 1), load(rows, row + 2), load(rows, row + 3)
    w = h[6] * x + h[7] * y + h[8]
    e, f = h[0] * x + h[1] * y + h[2] - u * w, h[3] * x + h[4] * y + h[5] - v * w
    a, b, c, d = h[0] - u * h[6], h[1] - u * h[7], h[3] - v * h[6], h[4] - v * h[7]
    area, w2 = a * d - b * c, w * w
    determinant = area * area + w2 * (a * a + b * b + c * c + d * d + w2)
    inverse = 1.0 / where(determinant > TINY, determinant, TINY)
    i00, i01, i11 = (c * c + d * d + w2) * inverse, (a * c + b * d) * inverse, (a * a + b * b + w2) * inverse
    l0, l1 = i00 * e - i01 * f, i11 * f - i01 * e
    if derivatives:
        X, Y, du, dv = x - (a * l0 + c * l1), y - (b * l0 + d * l1), w * l0, w * l1
        store(factors, 0, X)
        store(factors, 1, Y)
        store(factors, 2, fill(1.0))
        store(factors, 3, 0.0 - (u * X + x * du))
        store(factors, 4, 0.0 - (u * Y + y * du))
        store(factors, 5, 0.0 - (u + du))
        store(factors, 6, 0.0 - (v * X + x * dv))
        store(factors, 7, 0.0 - (v * Y + y * dv))
        store(factors, 8, 0.0 - (v + dv))
        store(factors, 9, i00)
        store(factors, 10, 0.0 - i01)
        store(factors, 11, i11)
        store(factors, 12, l0)
        store(factors, 13, l1)
    r2 = e * l0 + f * l1
    return where(w > 0.0, r2, where(w == w, BEHIND, r2))  # what is not a number stays none


@inner
def _add_products(factors: Array, counted: Any, sums: Array) -> None:
    """Adds the products of LANES matches, times what they count; factors: of `_linearise`.

    The blocks share their factors, so there are 52 sums in place of the 55 of each row of G: those of t t^T with the
    three entries of the inverse (6 each), of t with the rows of the last block (9 each), of that block (6), the
    gradient (9); the caller adds that of r^2.
    """
    p, q, s = load(factors, 9) * counted, load(factors, 10) * counted, load(factors, 11) * counted
    l0, l1 = load(factors, 12) * counted, load(factors, 13) * counted
    place = 0
    for r in range(3):
        t, c, d = load(factors, r), load(factors, 3 + r), load(factors, 6 + r)
        m, n = p * c + q * d, q * c + s * d
        for k in range(3):
            if k >= r:
                both = t * load(factors, k)
                store(sums, place, load(sums, place) + p * both)
                store(sums, 6 + place, load(sums, 6 + place) + q * both)
                store(sums, 12 + place, load(sums, 12 + place) + s * both)
                last = m * load(factors, 3 + k) + n * load(factors, 6 + k)
                store(sums, 36 + place, load(sums, 36 + place) + last)
                place += 1
            across = 18 + 3 * k + r
            store(sums, across, load(sums, across) + load(factors, k) * m)
            store(sums, across + 9, load(sums, across + 9) + load(factors, k) * n)
        store(sums, 42 + r, load(sums, 42 + r) + t * l0)
        store(sums, 45 + r, load(sums, 45 + r) + t * l1)
        store(sums, 48 + r, load(sums, 48 + r) + (c * l0 + d * l1))


@inner
def _assemble(sums: Array, products: Array) -> None:
    """The sums of `_add_products` -> products (10, 10)."""
    place = 0
    for r in range(3):
        for c in range(r, 3):
            p, q, s = added(load(sums, place)), added(load(sums, 6 + place)), added(load(sums, 12 + place))
            last = added(load(sums, 36 + place))
            products[r, c], products[c, r] = p, p
            products[r, 3 + c], products[c, 3 + r], products[3 + r, c], products[3 + c, r] = q, q, q, q
            products[3 + r, 3 + c], products[3 + c, 3 + r] = s, s
            products[6 + r, 6 + c], products[6 + c, 6 + r] = last, last
            place += 1
    for r in range(3):
        for c in range(3):
            m, n = added(load(sums, 18 + 3 * r + c)), added(load(sums, 27 + 3 * r + c))
            products[r, 6 + c], products[6 + c, r] = m, m
            products[3 + r, 6 + c], products[6 + c, 3 + r] = n, n
    for i in range(10):
        total = added(load(sums, 42 + i))
        products[i, 9], products[9, i] = total, total


@kernel
def refine_homographies(H: F8x2, matches: Weighted, schedule: Schedule, out: F8x2, cost: F8x1) -> None:
    """Models (k, 9) refined -> out (k, 9), of unit norm, cost (k,); what cannot be is not finite, nor its cost."""
    k = len(H)
    state = _State(out, np.empty((k, 10, 10)), cost)
    trial = _State(matrix(k, 9), np.empty((k, 10, 10)), vector(k))
    for i in range(k):
        assign(out[i], H[i])
        unit(out[i])
    problem = Problem(matches, schedule.tolerance)
    _minimise(problem, state, trial, np.full(k, schedule.damping), schedule.iterations, schedule.tolerance > 0)


@kernel(holds_gil=True)
def step_of_homography(H: F8x1, matches: Weighted, damping: float, out: F8x1) -> None:
    """One damped Gauss-Newton step of a model (9,) -> out (9,), of unit norm."""
    at, products, cost, Q = matrix(1, 9), np.empty((1, 10, 10)), vector(1), matrix(18, LANES)
    assign(at[0], H)
    unit(at[0])
    evaluate_homographies(at, matches, True, products, cost)
    _stepped(products[0], at[0], damping, Q, out)


@inner
def _evaluate(state: _State, problem: Problem, derivatives: bool) -> None:
    evaluate_homographies(state.H, problem.matches, derivatives, state.products, state.cost)


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
def _take(state: _State, trial: _State, k: int) -> None:
    assign(state.H[k], trial.H[k])
    assign_rows(state.products[k], trial.products[k])


_minimise = levenberg_marquardt(_evaluate, _step, accepting(_take))
