"""`focal.posterior` on the arrays of one pair: refinement with the prior, by kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmtorch.estimators.focal import posterior, refined_kernels
from fmtorch.estimators.focal.posterior_kernels import minimise
from fmtorch.estimators.one_pair.focal.cameras import CentredPair, TwoCameras, images_of
from fmtorch.estimators.one_pair.pair import Array, OnePair, squared
from fmtorch.estimators.one_pair.refinement import Near
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


class Refined(NamedTuple):
    """Of k candidates, models (k, 9), prior costs (k,), shares in front (k,), cameras."""

    models: Array
    cost: Array
    share: Array
    cameras: TwoCameras


def refine_with_prior(F: Array, pair: OnePair, iterations: int) -> Refined:
    """As `posterior.refine_with_prior` of models (k, 9)."""
    made = _room(len(F))
    refined_kernels.refine_with_prior(F, pair.table, *prior_of(pair, iterations), *_flat(made))
    return made


def refine_near_with_prior(F: Array, pair: OnePair, near: Near, iterations: int) -> Refined:
    """The same of models (k, 9), float32, on the matches near them."""
    made = _room(len(F))
    refined_kernels.refine_near_with_prior(
        F, pair.points32, near.limit, near.mixed_seed, near.key, near.most, pair.table, *prior_of(pair, iterations),
        *_flat(made),
    )  # fmt: skip
    return made


def _room(k: int) -> Refined:
    return Refined(np.empty((k, 9)), np.empty(k), np.empty(k), TwoCameras(np.empty((k, 2, 3, 3)), np.empty((k, 2))))


def _flat(made: Refined) -> tuple[Array, Array, Array, Array, Array]:
    """In the kernels' order."""
    return *made.cameras, made.models, made.cost, made.share


def prior_of(pair: OnePair, iterations: int) -> tuple[Array, Array, bool, float, int, Array, float, float, int]:
    """What the kernels take of a pair's images and of the objective."""
    offset, longest, same_size = images_of(pair)
    unit = pair.pixels_per_unit
    return (
        offset, longest, same_size, posterior.LOSS_SCALE_PX, LOSSES["geman_mcclure"], LOSS_TABLE,
        squared(unit / posterior.INLIER_SIGMA_PX), posterior.PARALLEL_PX / unit, iterations,
    )  # fmt: skip
