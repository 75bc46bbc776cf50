"""Levenberg-Marquardt: the one loop of all non-linear fits, over the models of one pair.

Damped Gauss-Newton steps; each model takes its own where that lowers its cost, and else tries a shorter one (Marquardt
1963; Hartley & Zisserman 2004, appendix 6.2). The objective is a set of inner functions, so that a whole fit is one
call, between whose steps nothing waits for Python.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.kernel import inner
from fmtorch.geometry.sampson_objective_kernels import Weighted

FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-4, 1e-12, 1e6  # relative to the greatest curvature


class Schedule(NamedTuple):
    """iterations: steps at most. damping: of the first. tolerance: a model is done once a step has lowered its cost by
    no more than this share of it; 0: none is ever done."""

    iterations: int
    damping: float
    tolerance: float


def levenberg_marquardt(
    evaluate: Callable[..., None], step: Callable[..., None], accept: Callable[..., bool]
) -> Callable[[Any, Any, Any, Array, int, bool], None]:
    """The loop for an objective: loop(data, state, trial, damping, iterations, ends), in place.

    evaluate(state, data, derivatives): the costs, and the derivatives if asked for, at the state's parameters.
    step(state, damping, trial): those of a trial. accept(state, trial, damping, done, data): the trial for the models
    that it improves; whether all are done.
    """

    @inner
    def loop(data: Any, state: Any, trial: Any, damping: Array, iterations: int, ends: bool) -> None:
        """The state holds the start, then that of least cost; no cost ever rises.

        damping: (k,), the first of each model. ends: whether models are ever done; the state then keeps the
        derivatives at the end.
        """
        done = np.zeros(len(damping), np.bool_)
        evaluate(state, data, iterations > 0 or ends)
        for i in range(iterations):
            step(state, damping, trial)
            evaluate(trial, data, i + 1 < iterations or ends)
            if accept(state, trial, damping, done, data) and ends:
                break

    return loop


class Problem(NamedTuple):
    """The matches of a robust error, and the tolerance of the schedule: what `accepting` looks at."""

    matches: Weighted
    tolerance: float


def accepting(take: Callable[[Any, Any, int], None]) -> Callable[..., bool]:
    """The `accept` of an objective on a `Problem`: a step that is taken divides the damping by 10, another multiplies.

    take(state, trial, k): gives the state model k of the trial; costs are copied here.
    """

    @inner
    def accept(state: Any, trial: Any, damping: Array, done: Array, problem: Problem) -> bool:
        everything = True
        for k in range(len(damping)):
            better = trial.cost[k] < state.cost[k] and not done[k]
            damping[k] = min(max(damping[k] / 10 if better else damping[k] * 10, MIN_DAMPING), MAX_DAMPING)
            if better:
                done[k] |= problem.tolerance > 0 and state.cost[k] - trial.cost[k] <= problem.tolerance * state.cost[k]
                state.cost[k] = trial.cost[k]
                take(state, trial, k)
            everything = everything and done[k]
        return everything

    return accept
