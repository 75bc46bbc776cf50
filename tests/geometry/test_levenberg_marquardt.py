"""The loop of all non-linear fits, on a problem of known solution; its functions run interpreted."""

import itertools
from typing import NamedTuple

import numpy as np

from fmtorch.geometry.levenberg_marquardt import minimiser


class State(NamedTuple):
    """Numbers (k,), the costs ``(x^2 - 1)^2`` there, above a floor, and slope and curvature."""

    x: np.ndarray
    cost: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray


class Problem(NamedTuple):
    """tolerance: of the schedule. log: the costs of all trials, and whether derivatives were asked for."""

    tolerance: float
    log: list[tuple[np.ndarray, bool]]
    floor: float


def evaluate(state: State, problem: Problem, derivatives: bool) -> None:
    e = state.x * state.x - 1
    state.cost[:] = e * e + problem.floor
    problem.log.append((e * e, derivatives))
    if derivatives:
        state.slope[:], state.curvature[:] = 2 * state.x * e, 4 * state.x * state.x


def step(state: State, damping: np.ndarray, trial: State) -> None:
    trial.x[:] = state.x - state.slope / (state.curvature * (1 + damping))


def take(state: State, trial: State, k: int) -> None:
    state.x[k], state.slope[k], state.curvature[k] = trial.x[k], trial.slope[k], trial.curvature[k]


minimise = minimiser(evaluate, step, take)


START = np.array([3.0, 1e-3, -2.0])


def fitted(
    iterations: int, tolerance: float = 0.0, start: np.ndarray = START, floor: float = 0.0
) -> tuple[State, list]:
    """The end of a fit, and its log."""
    state, trial = (State(start.copy(), *np.full((3, len(start)), np.nan)) for _ in range(2))
    problem = Problem(tolerance, [], floor)
    minimise(problem, state, trial, np.full(len(start), 1e-3), iterations, tolerance > 0)
    return state, problem.log


def test_reaches_the_minima_and_no_cost_rises() -> None:
    np.testing.assert_allclose(np.abs(fitted(40)[0].x), 1, rtol=0, atol=1e-9)
    costs = [fitted(i)[0].cost for i in range(12)]
    assert all((later <= earlier).all() for earlier, later in itertools.pairwise(costs))


def test_rejected_steps_are_made_again_with_more_damping() -> None:
    """From 0.001 a Gauss-Newton step leaps to 500, where the cost is larger; the fit must come back from there."""
    assert fitted(3)[1][1][0][1] > 1e9
    assert fitted(40)[0].cost[1] < 1e-18


def test_a_rejected_step_ends_no_fit() -> None:
    """The first step from 0.001 raises the cost: that is no sign that the fit has converged."""
    assert fitted(40, 1e-9, START[1:2])[0].cost[0] < 1e-6


def test_a_fit_ends_where_nothing_is_gained() -> None:
    state, log = fitted(100, 1e-9, np.full(3, 1.5), floor=1.0)
    assert len(log) < 20
    assert state.cost.max() < 1 + 1e-9
