"""`geometry.refine.refine_components` on the arrays of one pair, by kernels."""

from __future__ import annotations

import numpy as np

from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.geometry import rank2_manifold_kernels as manifold
from fmtorch.geometry.optimum import STEP_DAMPING
from fmtorch.geometry.rank2_manifold import SQUARINGS
from fmtorch.geometry.refine import DAMPING
from fmtorch.geometry.refine_kernels import refine
from fmtorch.geometry.sampson_objective_kernels import LOSSES, evaluate
from fmtorch.geometry.sigma_consensus import LOSS_TABLE


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
    s2 = np.square(scale_px / pair.scale)
    found, cost = refined(F, pair.points, pair.weight, loss, s2, iterations, squarings, tolerance, damping)
    return np.where(np.isfinite(cost)[:, None], found, F)


def refined(
    F: Array, points: Array, weight: Array, loss: str, s2: Array, iterations: int, squarings: int = SQUARINGS,
    tolerance: float | None = None, damping: float = DAMPING.first,
) -> tuple[Array, Array]:  # fmt: skip
    """Models (k, 9) refined on points (4, n), and their costs (k,); where there is none, neither is finite.

    s2: (n,), squared scales of the loss. tolerance: None, or the share of its cost by which a step must lower it.
    """
    found, cost, least = np.empty_like(F), np.empty(len(F)), tolerance or 0.0
    refine(F, squarings, points, weight, s2, LOSSES[loss], LOSS_TABLE, iterations, damping, least, found, cost)
    return found, cost


def gauss_newton_step(F: Array, points: Array, weight: Array) -> Array:
    """The model (9,) of unit norm after the step of `geometry.attached_step`; itself where there is none."""
    at, moved = ((np.empty((1, 9)), np.empty((1, 3)), np.empty((1, 3))) for _ in range(2))
    products, cost, s2 = np.empty((1, 10, 10)), np.empty(1), np.full(len(weight), np.inf)
    manifold.start(F[None], SQUARINGS, *at)
    evaluate(at[0], points, weight, s2, LOSSES["truncated"], LOSS_TABLE, True, products, cost)
    manifold.step(products, *at, np.full(1, STEP_DAMPING), *moved)
    (found,) = moved[0]
    return found if np.isfinite(found).all() else F
