"""`focal.posterior` on the arrays of one pair: refinement with the prior, by kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmtorch.estimators.focal import posterior
from fmtorch.estimators.focal.cameras_kernels import nearest_cameras
from fmtorch.estimators.focal.cheirality_kernels import share_in_front
from fmtorch.estimators.focal.posterior_kernels import minimise, models_and_costs
from fmtorch.estimators.one_pair.focal.cameras import CentredPair, TwoCameras
from fmtorch.estimators.one_pair.pair import Array, OnePair, squared
from fmtorch.geometry.sampson_objective_kernels import LOSSES
from fmtorch.geometry.sigma_consensus import LOSS_TABLE


class Optimum(NamedTuple):
    """Cameras of k candidates, their models (k, 9), costs (k,), and derivatives (k, 7), (k, 7, 7)."""

    cameras: TwoCameras
    F: Array
    cost: Array
    gradient: Array
    hessian: Array


def optimum(
    start: TwoCameras, pair: OnePair, loss: str, scale_px: float, sigma_px: float, iterations: int,
    tolerance: float | None = None,
) -> Optimum:  # fmt: skip
    """`posterior.Posterior` minimised near the start, whose arrays become the cameras there.

    scale_px, sigma_px: of the loss and of an inlier's Sampson distance. Without tolerance the derivatives are not those
    at the end.
    """
    k, centred = len(start.focal), CentredPair.of(pair, scale_px)
    F, cost, gradient, hessian = np.empty((k, 9)), np.empty(k), np.empty((k, 7)), np.empty((k, 7, 7))
    minimise(
        *start, centred.points, pair.weight, centred.s2, LOSSES[loss], LOSS_TABLE,
        centred.longest, centred.same_size, squared(pair.pixels_per_unit / sigma_px), iterations,
        -1.0 if tolerance is None else tolerance, F, cost, gradient, hessian,
    )  # fmt: skip
    return Optimum(start, F, cost, gradient, hessian)


def refine_with_prior(F: Array, pair: OnePair, iterations: int) -> tuple[Array, Array, Array, TwoCameras]:
    """As `posterior.refine_with_prior` of models (k, 9): models, prior costs (k,), shares in front (k,), cameras."""
    k, centred = len(F), CentredPair.of(pair, posterior.LOSS_SCALE_PX)
    cameras = TwoCameras(np.empty((k, 2, 3, 3)), np.empty((k, 2)))
    nearest_cameras(F, centred.offset, centred.longest, *cameras)
    found = optimum(cameras, pair, "geman_mcclure", posterior.LOSS_SCALE_PX, posterior.INLIER_SIGMA_PX, iterations)
    models, cost, share = np.empty((k, 9)), np.empty(k), np.empty(k)
    models_and_costs(found.F, found.cost, cameras.focal, centred.offset, centred.same_size, models, cost)
    parallel = posterior.PARALLEL_PX / pair.pixels_per_unit
    share_in_front(*cameras, centred.longest, found.F, centred.points, pair.support, centred.precision, parallel, share)
    return models, cost, share, cameras
