"""Levenberg-Marquardt of the robust Sampson error on the manifold of rank 2 and unit norm, for the models of a pair."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, F8x1, F8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.geometry.levenberg_marquardt_kernels import Problem, Schedule, accepting, levenberg_marquardt
from fmtorch.geometry.rank2_kernels import assign, assign_rows
from fmtorch.geometry.rank2_manifold_kernels import start_one, steps
from fmtorch.geometry.sampson_objective_kernels import Weighted, evaluate


class _State(NamedTuple):
    """Models of rank 2 (k, 9), their epipoles (k, 3), and the normal equations (k, 10, 10) and costs (k,) there."""

    F: Array
    e0: Array
    e1: Array
    products: Array
    cost: Array


@kernel
def refine(F: F8x2, squarings: int, matches: Weighted, schedule: Schedule, out: F8x2, cost: F8x1) -> None:
    """Models (k, 9) made rank 2 and refined -> out (k, 9), cost (k,); what cannot be is not finite, nor its cost.

    squarings: of `start_one`.
    """
    k = len(F)
    state = _State(out, matrix(k, 3), matrix(k, 3), np.empty((k, 10, 10)), cost)
    trial = _State(matrix(k, 9), matrix(k, 3), matrix(k, 3), np.empty((k, 10, 10)), vector(k))
    problem = Problem(matches, schedule.tolerance)
    for i in range(k):
        start_one(F[i], squarings, state.F[i], state.e0[i], state.e1[i])
    _minimise(problem, state, trial, np.full(k, schedule.damping), schedule.iterations, schedule.tolerance > 0)


@inner
def _evaluate(state: _State, problem: Problem, derivatives: bool) -> None:
    evaluate(state.F, problem.matches, derivatives, state.products, state.cost)


@inner
def _step(state: _State, damping: Array, trial: _State) -> None:
    steps(state.products, state.F, state.e0, state.e1, damping, trial.F, trial.e0, trial.e1)


@inner
def _take(state: _State, trial: _State, k: int) -> None:
    assign(state.F[k], trial.F[k])
    assign(state.e0[k], trial.e0[k])
    assign(state.e1[k], trial.e1[k])
    assign_rows(state.products[k], trial.products[k])


_minimise = levenberg_marquardt(_evaluate, _step, accepting(_take))
