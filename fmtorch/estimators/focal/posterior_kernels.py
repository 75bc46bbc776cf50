"""`posterior.Posterior` minimised for the candidates of one pair, compiled: one call for a whole fit.

axes: (k, 2, 3, 3), U and V of ``E = U diag(1, 1, 0) V^T``, rows first. focal: (k, 2), logarithms of focal lengths in
units of the longer sides. longest: (2,), these sides in the unit of the points, which are from the principal points.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.lanes import LANES, fill, load, store
from fmtorch.estimators.focal.cameras_kernels import translate
from fmtorch.estimators.focal.prior_kernels import focal_cost
from fmtorch.geometry.arithmetic_kernels import exponential
from fmtorch.geometry.levenberg_marquardt_kernels import levenberg_marquardt
from fmtorch.geometry.rank2_kernels import assign, assign_rows, unit
from fmtorch.geometry.rank2_manifold_kernels import eliminate
from fmtorch.geometry.sampson_objective_kernels import evaluate

Array = NDArray[Any]
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-9, 1e6  # as in `posterior`


class _State(NamedTuple):
    """Of k candidates, cameras, models (k, 9), costs (k,), and their derivatives (k, 7), (k, 7, 7)."""

    axes: Array
    focal: Array
    F: Array
    cost: Array
    gradient: Array
    hessian: Array


class _Data(NamedTuple):
    """What `minimise` is given of matches and images; tangents (k, 9, LANES), of which 7 count, and products
    (k, 10, 10) for the work."""

    points: Array
    weight: Array
    s2: Array
    loss: int
    table: Array
    longest: Array
    same_size: bool
    precision: float
    tolerance: float
    tangents: Array
    products: Array


@kernel(
    "f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], i8, f8[:, ::1], f8[::1], b1, f8, i8, f8, "
    "f8[:, ::1], f8[::1], f8[:, ::1], f8[:, :, ::1]"
)
def minimise(
    axes: Array, focal: Array, points: Array, weight: Array, s2: Array, loss: int, table: Array, longest: Array,
    same_size: bool, precision: float, iterations: int, tolerance: float, F: Array, cost: Array, gradient: Array,
    hessian: Array,
) -> None:  # fmt: skip
    """Cameras of least negative logarithm of the posterior near axes and focal, in place; what it is there.

    points, weight, s2, loss, table: of `sampson_objective_kernels.evaluate`. precision: one over the variance of an
    inlier's distance. tolerance: what a step must lower the cost of a candidate by, if its fit is to go on; negative:
    none is ever done, and the derivatives are not those at the end. Models -> F (k, 9), costs (k,), their derivatives
    by five rotations and two logarithms -> gradient (k, 7), hessian (k, 7, 7).
    """
    k = len(cost)
    state = _State(axes, focal, F, cost, gradient, hessian)
    trial = _State(
        np.empty((k, 2, 3, 3)), np.empty((k, 2)), np.empty((k, 9)), np.empty(k), np.empty((k, 7)), np.empty((k, 7, 7))
    )
    data = _Data(
        points, weight, s2, loss, table, longest, same_size, precision, tolerance, np.zeros((k, 9, LANES)),
        np.empty((k, 10, 10)),
    )  # fmt: skip
    _minimise(data, state, trial, np.full(k, FIRST_DAMPING), iterations, tolerance >= 0)


@inner
def _evaluate(state: _State, data: _Data, derivatives: bool) -> None:
    _models(state.axes, state.focal, data.longest, state.F, data.tangents)
    evaluate(state.F, data.points, data.weight, data.s2, data.loss, data.table, derivatives, data.products, state.cost)
    work = np.empty(4)
    for k in range(len(state.cost)):
        prior = focal_cost(state.focal[k], data.same_size, work)
        state.cost[k] = state.cost[k] * data.precision / 2 + prior
        if derivatives:
            _derivatives(data.products[k], data.tangents[k], work, data.precision, state.gradient[k], state.hessian[k])


@inner
def _models(axes: Array, focal: Array, longest: Array, F: Array, tangents: Array) -> None:
    """Fundamental matrices -> F (k, 9), and their derivatives by five rotations and two logarithms -> (k, 9, LANES)."""
    for k in range(len(F)):
        U, V, T = axes[k, 0], axes[k, 1], tangents[k]
        d0, d1 = exponential(focal[k, 0]) * longest[0], exponential(focal[k, 1]) * longest[1]
        for r in range(3):
            for c in range(3):
                by, q = (d0 if c == 2 else 1.0) * (d1 if r == 2 else 1.0), 3 * r + c
                F[k, q] = (U[r, 0] * V[c, 0] + U[r, 1] * V[c, 1]) * by
                T[q, 0], T[q, 1] = U[r, 2] * V[c, 1] * by, -U[r, 2] * V[c, 0] * by
                T[q, 2] = (U[r, 1] * V[c, 0] - U[r, 0] * V[c, 1]) * by
                T[q, 3], T[q, 4] = U[r, 1] * V[c, 2] * by, -U[r, 0] * V[c, 2] * by
                T[q, 5], T[q, 6] = F[k, q] if c == 2 else 0.0, F[k, q] if r == 2 else 0.0


@inner
def _derivatives(
    products: Array, tangents: Array, prior: Array, precision: float, gradient: Array, hessian: Array
) -> None:  # fmt: skip
    """Of one candidate. products: (10, 10), of `evaluate`; tangents: (9, LANES); prior: (4,), of `focal_cost`."""
    along, column = np.empty((10, LANES)), np.empty((1, LANES))
    for j in range(10):
        total = fill(0.0)
        for q in range(9):
            total += load(tangents, q) * products[q, j]
        store(along, j, total)
    for i in range(7):
        gradient[i] = along[9, i] * precision
    for j in range(7):
        total = fill(0.0)
        for q in range(9):
            total += load(tangents, q) * along[q, j]
        store(column, 0, total * precision)
        for i in range(7):
            hessian[i, j] = column[0, i]
    for i in range(2):
        gradient[5 + i] += prior[i]
        for j in range(2):
            hessian[5 + i, 5 + j] += prior[2] if i == j else prior[3]


@inner
def _step(state: _State, damping: Array, trial: _State) -> None:
    Q = np.empty((7, LANES))
    for k in range(len(damping)):
        damped_step(state.hessian[k], state.gradient[k], damping[k], Q)
        _rotate(state.axes[k, 0], Q[0, 7] / 2, Q[1, 7] / 2, Q[2, 7] / 2, trial.axes[k, 0])
        _rotate(state.axes[k, 1], Q[3, 7] / 2, Q[4, 7] / 2, 0.0, trial.axes[k, 1])
        for i in range(2):
            trial.focal[k, i] = min(max(state.focal[k, i] + min(max(Q[5 + i, 7], -1.0), 1.0), -3.0), 3.0)


@inner
def damped_step(hessian: Array, gradient: Array, damping: float, Q: Array) -> None:
    """Solves ``(H + damping diag H) x = -gradient`` -> last column of Q (7, LANES)."""
    for i in range(7):
        for j in range(7):
            Q[i, j] = hessian[i, j]
        Q[i, i] += hessian[i, i] * damping
        Q[i, 7] = -gradient[i]
    eliminate(Q, 7)


@inner
def _rotate(A: Array, x: float, y: float, z: float, out: Array) -> None:
    """``A R`` with the Cayley rotation of (x, y, z), half of its angles -> out (3, 3)."""
    n = x * x + y * y + z * z
    factor = 2 / (1 + n)
    for r in range(3):
        a, b, c = A[r, 0], A[r, 1], A[r, 2]
        along = a * x + b * y + c * z
        out[r, 0] = a + factor * (z * b - y * c + along * x - n * a)
        out[r, 1] = b + factor * (x * c - z * a + along * y - n * b)
        out[r, 2] = c + factor * (y * a - x * b + along * z - n * c)


@inner
def _accept(state: _State, trial: _State, damping: Array, done: Array, data: _Data) -> bool:
    everything = True
    for k in range(len(damping)):
        better = trial.cost[k] < state.cost[k] and not done[k]
        damping[k] = min(max(damping[k] / 10 if better else damping[k] * 10, MIN_DAMPING), MAX_DAMPING)
        if better:
            done[k] |= data.tolerance >= 0 and state.cost[k] - trial.cost[k] <= data.tolerance
            state.cost[k] = trial.cost[k]
            assign(state.focal[k], trial.focal[k])
            assign(state.F[k], trial.F[k])
            assign(state.gradient[k], trial.gradient[k])
            assign_rows(state.axes[k, 0], trial.axes[k, 0])
            assign_rows(state.axes[k, 1], trial.axes[k, 1])
            assign_rows(state.hessian[k], trial.hessian[k])
        everything = everything and done[k]
    return everything


_minimise = levenberg_marquardt(_evaluate, _step, _accept)


@kernel("f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], b1, f8[:, ::1], f8[::1]", brief=True)
def models_and_costs(
    F: Array, cost: Array, focal: Array, offset: Array, same_size: bool, models: Array, prior: Array
) -> None:  # fmt: skip
    """What `minimise` found, as models of unit norm -> (k, 9), and what the prior costs -> (k,), infinite of no model.

    F, cost, focal: of `minimise`. offset: (4,), what is taken from the points to have those of the models.
    """
    work = np.empty(4)
    translate(F, offset, models)
    for k in range(len(F)):
        unit(models[k])
        prior[k] = focal_cost(focal[k], same_size, work)
        finite = math.isfinite(cost[k])
        for i in range(9):
            finite = finite and math.isfinite(models[k, i])
        if not finite:
            prior[k] = math.inf
