"""`irls` on the arrays of one pair: from the matches to the model of least cost."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fmtorch.estimators.one_pair.inliers import median_of_matches
from fmtorch.estimators.one_pair.pair import Array, OnePair, squared
from fmtorch.estimators.one_pair.refine import refined
from fmtorch.estimators.pool_kernels import residuals_squared
from fmtorch.geometry.eight_point_kernels import weighted_eight_point
from fmtorch.geometry.irls_kernels import reweighted
from fmtorch.geometry.sampson_objective_kernels import LOSSES
from fmtorch.geometry.sigma_consensus import LOSS_TABLE


def optimum(
    pair: OnePair, loss: str, scale: float, powers: Sequence[int], first_scale: float, decays: Sequence[float],
    iterations: int,
) -> tuple[Array, bool]:  # fmt: skip
    """The model (3, 3) of `IterativelyReweighted`, before its last step, and whether there is one.

    scale: of the loss, in the unit of the points. powers: of the weights, one for each start. first_scale: in robust
    standard deviations. decays: the share of the first scale in each iteration. iterations: of Levenberg-Marquardt.
    """
    weight = weights(pair)
    powered = [np.ones_like(weight)]
    for _ in range(max(powers)):  # NumPy's powers have other last bits on another processor
        powered.append(powered[-1] * weight)
    F, fitted = np.empty((len(powers), 9)), np.empty(len(powers), np.bool_)
    for i, power in enumerate(powers):
        fitted[i] = weighted_eight_point(pair.points, powered[power], F[i])
    F = F[fitted]
    if not len(F):
        return np.zeros((3, 3)), False
    widest = first_scale * 1.4826 * math.sqrt(max(_median(model, pair) for model in F))
    for decay in decays:
        s2 = np.full(pair.count, squared(max(widest * decay, scale)))
        reweighted(F, pair.points, weight, s2, LOSSES[loss], LOSS_TABLE)
    found, cost = refined(F, pair.points, weight, loss, np.full(pair.count, squared(scale)), iterations)
    cost = np.where(np.isfinite(cost), cost, np.inf)
    best = int(np.argmin(cost))
    return found[best].reshape(3, 3), bool(np.isfinite(cost[best]))


def weights(pair: OnePair) -> Array:
    """As `irls._weight`, (n,): the prior, or the rank by quality, or ones."""
    if pair.prior is not None:
        return pair.prior
    if pair.quality is None:
        return np.ones(pair.count)
    rank = np.empty(pair.count, np.float32)  # as torch divides integers
    rank[np.argsort(pair.quality, kind="stable")] = np.arange(pair.count)
    return (np.float32(1) - rank / np.float32(pair.count)).astype(np.float64)


def _median(F: Array, pair: OnePair) -> float:
    """The median squared residual of a model (9,), in the unit of the points."""
    r2 = np.empty(pair.count)
    residuals_squared(F, pair.points, 1.0, r2)
    return median_of_matches(r2)
