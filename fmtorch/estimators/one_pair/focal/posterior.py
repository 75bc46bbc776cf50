"""`focal.posterior` on the arrays of one pair: refinement with the prior, its arithmetic by kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmtorch.estimators.focal import posterior
from fmtorch.estimators.focal import posterior_kernels as compiled
from fmtorch.estimators.focal.cameras_kernels import nearest_cameras, translate
from fmtorch.estimators.focal.cheirality_kernels import share_in_front
from fmtorch.estimators.focal.prior_kernels import prior_costs
from fmtorch.estimators.one_pair.focal.cameras import CentredPair, TwoCameras
from fmtorch.estimators.one_pair.pair import Array, OnePair, squared
from fmtorch.geometry.levenberg_marquardt import levenberg_marquardt
from fmtorch.geometry.sampson_objective_kernels import LOSSES, evaluate
from fmtorch.geometry.sigma_consensus import LOSS_TABLE


class State(NamedTuple):
    """As `posterior.State`: of k candidates, cameras, models (k, 9), costs (k,), and their derivatives.

    gradient: (k, 7), hessian: (k, 7, 7), tangents: (k, 9, 7).
    """

    axes: Array
    focal: Array
    F: Array
    cost: Array
    gradient: Array
    hessian: Array
    tangents: Array


class Posterior:
    """As `posterior.Posterior`. scale_px, sigma_px: of the loss and of an inlier's Sampson distance."""

    def __init__(
        self, pair: OnePair, loss: str, scale_px: float, sigma_px: float, tolerance: float | None = None
    ) -> None:
        self.centred, self.tolerance = CentredPair.of(pair), tolerance
        self.data = self.centred.points, pair.weight, np.square(scale_px / pair.scale), LOSSES[loss], LOSS_TABLE
        self.precision = squared(pair.pixels_per_unit / sigma_px)

    def evaluate(self, parameters: tuple[Array, Array], derivatives: bool) -> State:
        """As `Objective.evaluate`; parameters: axes and log focal lengths."""
        k, centred = len(parameters[1]), self.centred
        state = State(
            *parameters, np.empty((k, 9)), np.empty(k), np.empty((k, 7)), np.empty((k, 7, 7)), np.empty((k, 9, 7))
        )
        products = np.zeros((k, 10, 10))
        compiled.models(state.axes, state.focal, centred.longest, state.F, state.tangents)
        evaluate(state.F, *self.data, derivatives, products, state.cost)
        compiled.posterior(
            products, state.cost, state.tangents, state.focal, centred.same_size, self.precision, state.hessian,
            state.gradient,
        )  # fmt: skip
        return state

    def begin(self, state: State) -> tuple[Array, Array]:
        """As `Objective.begin`."""
        return np.full(len(state.cost), posterior.Posterior.damping.first), np.zeros(len(state.cost), np.bool_)

    def step(self, state: State, damping: Array) -> tuple[Array, Array]:
        """As `Objective.step`."""
        moved = np.empty_like(state.axes), np.empty_like(state.focal)
        compiled.step(state.axes, state.focal, state.hessian, state.gradient, damping, *moved)
        return moved

    def accept(self, state: State, trial: State, damping: Array, done: Array) -> tuple[State, Array, Array]:
        """As `Objective.accept`, in place."""
        compiled.accept(*state, *trial, damping, done, -1.0 if self.tolerance is None else self.tolerance)
        return state, damping, done


def refine_with_prior(F: Array, pair: OnePair, iterations: int) -> tuple[Array, Array, Array, TwoCameras]:
    """As `posterior.refine_with_prior` of models (k, 9): models, prior costs (k,), shares in front (k,), cameras."""
    objective, k = Posterior(pair, "geman_mcclure", posterior.LOSS_SCALE_PX, posterior.INLIER_SIGMA_PX), len(F)
    centred, shifted, start = objective.centred, np.empty_like(F), TwoCameras(np.empty((k, 2, 3, 3)), np.empty((k, 2)))
    translate(F, -centred.offset, shifted)
    nearest_cameras(shifted, centred.longest, *start)
    state = levenberg_marquardt(objective, start, iterations)
    models, cost, share = np.empty_like(F), np.empty(k), np.empty(k)
    translate(state.F, centred.offset, shifted)
    compiled.to_unit_norm(shifted, models)
    prior_costs(state.focal, centred.same_size, cost)
    cost[~(np.isfinite(models).all(1) & np.isfinite(state.cost))] = np.inf
    support = np.ones(pair.count) if pair.prior is None else pair.prior
    depth, unit_px = np.exp(state.focal) * centred.longest, pair.pixels_per_unit
    scale, parallel = np.square(pair.scale / posterior.LOSS_SCALE_PX), posterior.PARALLEL_PX / unit_px
    share_in_front(state.axes, depth, state.F, centred.points, support, scale, parallel, share)
    return models, cost, share, TwoCameras(state.axes, state.focal)
