"""`geometry.refine.refine_components` on the arrays of one pair: the one loop, its arithmetic by kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.geometry import rank2_manifold_kernels as manifold
from fmtorch.geometry.levenberg_marquardt import levenberg_marquardt
from fmtorch.geometry.optimum import STEP_DAMPING
from fmtorch.geometry.rank2_manifold import SQUARINGS
from fmtorch.geometry.refine import DAMPING
from fmtorch.geometry.sampson_objective_kernels import LOSSES, evaluate
from fmtorch.geometry.sigma_consensus import LOSS_TABLE


class _State(NamedTuple):
    """Models of rank 2 (k, 9), their epipoles (k, 3), and the normal equations (k, 10, 10) and costs (k,) there."""

    F: Array
    e0: Array
    e1: Array
    products: Array
    cost: Array


class RankTwoObjective:
    """As `refine._RankTwoObjective`: the robust Sampson error on the manifold of rank 2 and unit norm.

    s2: (n,), squared scales of the loss. tolerance: None, or the share of its cost by which a step must lower it.
    """

    def __init__(
        self, points: Array, weight: Array, loss: str, s2: Array, tolerance: float | None, damping: float
    ) -> None:
        self.data = points, weight, s2, LOSSES[loss], LOSS_TABLE
        self.tolerance, self.damping = tolerance, damping

    def evaluate(self, parameters: tuple[Array, Array, Array], derivatives: bool) -> _State:
        """As `Objective.evaluate`; parameters: the models and their epipoles."""
        k = len(parameters[0])
        state = _State(*parameters, np.empty((k, 10, 10)), np.empty(k))
        evaluate(state.F, *self.data, derivatives, state.products, state.cost)
        return state

    def begin(self, state: _State) -> tuple[Array, Array]:
        """As `Objective.begin`."""
        return np.full(len(state.cost), self.damping), np.zeros(len(state.cost), np.bool_)

    def step(self, state: _State, damping: Array) -> tuple[Array, Array, Array]:
        """As `Objective.step`."""
        moved = np.empty_like(state.F), np.empty_like(state.e0), np.empty_like(state.e1)
        manifold.step(state.products, state.F, state.e0, state.e1, damping, *moved)
        return moved

    def accept(self, state: _State, trial: _State, damping: Array, done: Array) -> tuple[_State, Array, Array]:
        """As `Objective.accept`, in place."""
        manifold.accept(*state, *trial, damping, done, self.tolerance or 0.0)
        return state, damping, done


def refine_models(
    F: Array,
    pair: OnePair,
    loss: str,
    scale_px: float,
    iterations: int,
    squarings: int,
    tolerance: float | None = None,
    damping: float = DAMPING.first,
) -> Array:
    """Models (k, 9) refined on all matches of a pair, by its prior and noise; one that cannot be is as it was."""
    objective = RankTwoObjective(pair.points, pair.weight, loss, np.square(scale_px / pair.scale), tolerance, damping)
    start = np.empty_like(F), np.empty((len(F), 3)), np.empty((len(F), 3))
    manifold.start(F, squarings, *start)
    state = levenberg_marquardt(objective, start, iterations)
    return np.where(np.isfinite(state.cost)[:, None], state.F, F)


def gauss_newton_step(F: Array, points: Array, weight: Array) -> Array:
    """The model (9,) of unit norm after the step of `geometry.attached_step`; itself where there is none."""
    squared_scale = np.full(len(weight), np.inf)
    objective = RankTwoObjective(points, weight, "truncated", squared_scale, None, STEP_DAMPING)
    start = np.empty((1, 9)), np.empty((1, 3)), np.empty((1, 3))
    manifold.start(F[None], SQUARINGS, *start)
    state = objective.evaluate(start, True)
    moved: Array = objective.step(state, objective.begin(state)[0])[0][0]
    return moved if np.isfinite(moved).all() else F
