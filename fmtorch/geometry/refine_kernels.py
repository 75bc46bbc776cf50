"""`refine.refine_components` for the models of one pair, compiled: one call for a whole fit."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner, kernel
from fmtorch.geometry.levenberg_marquardt_kernels import levenberg_marquardt
from fmtorch.geometry.rank2_kernels import assign, assign_rows
from fmtorch.geometry.rank2_manifold_kernels import start_one, steps
from fmtorch.geometry.sampson_objective_kernels import evaluate

Array = NDArray[Any]
MIN_DAMPING, MAX_DAMPING = 1e-12, 1e6  # as in `refine`


class _State(NamedTuple):
    """Models of rank 2 (k, 9), their epipoles (k, 3), and the normal equations (k, 10, 10) and costs (k,) there."""

    F: Array
    e0: Array
    e1: Array
    products: Array
    cost: Array


class _Data(NamedTuple):
    """What `evaluate` takes of the matches; tolerance: of `refine`."""

    points: Array
    weight: Array
    s2: Array
    loss: int
    table: Array
    tolerance: float


@kernel("f8[:, ::1], i8, f8[:, ::1], f8[::1], f8[::1], i8, f8[:, ::1], i8, f8, f8, f8[:, ::1], f8[::1]")
def refine(
    F: Array, squarings: int, points: Array, weight: Array, s2: Array, loss: int, table: Array, iterations: int,
    first_damping: float, tolerance: float, out: Array, cost: Array,
) -> None:  # fmt: skip
    """Models (k, 9) made rank 2 and refined -> out (k, 9), cost (k,); what cannot be is not finite, nor its cost.

    points, weight, s2, loss, table: of `sampson_objective_kernels.evaluate`. squarings: of `start_one`. tolerance: a
    model is done once a step has lowered its cost by no more than this share of it; 0: none is ever done.
    """
    k = len(F)
    state = _State(out, np.empty((k, 3)), np.empty((k, 3)), np.empty((k, 10, 10)), cost)
    trial = _State(np.empty((k, 9)), np.empty((k, 3)), np.empty((k, 3)), np.empty((k, 10, 10)), np.empty(k))
    data = _Data(points, weight, s2, loss, table, tolerance)
    for i in range(k):
        start_one(F[i], squarings, state.F[i], state.e0[i], state.e1[i])
    _minimise(data, state, trial, np.full(k, first_damping), iterations, tolerance > 0)


@inner
def _evaluate(state: _State, data: _Data, derivatives: bool) -> None:
    evaluate(state.F, data.points, data.weight, data.s2, data.loss, data.table, derivatives, state.products, state.cost)


@inner
def _step(state: _State, damping: Array, trial: _State) -> None:
    steps(state.products, state.F, state.e0, state.e1, damping, trial.F, trial.e0, trial.e1)


@inner
def _accept(state: _State, trial: _State, damping: Array, done: Array, data: _Data) -> bool:
    everything = True
    for k in range(len(damping)):
        better = trial.cost[k] < state.cost[k] and not done[k]
        damping[k] = min(max(damping[k] / 10 if better else damping[k] * 10, MIN_DAMPING), MAX_DAMPING)
        if better:
            done[k] |= data.tolerance > 0 and state.cost[k] - trial.cost[k] <= data.tolerance * state.cost[k]
            state.cost[k] = trial.cost[k]
            assign(state.F[k], trial.F[k])
            assign(state.e0[k], trial.e0[k])
            assign(state.e1[k], trial.e1[k])
            assign_rows(state.products[k], trial.products[k])
        everything = everything and done[k]
    return everything


_minimise = levenberg_marquardt(_evaluate, _step, _accept)
