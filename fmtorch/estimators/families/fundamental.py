"""Fundamental matrices without assumptions: samples of seven or eight matches, refined on the manifold of rank 2."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np

from fmtorch.compiling.arrays import Array
from fmtorch.estimators.families.family import FitScale, Hypotheses, Loss, Steps
from fmtorch.estimators.pair import Pair, to_pixels
from fmtorch.geometry.eight_point_kernels import eight_point, weighted_eight_point
from fmtorch.geometry.levenberg_marquardt_kernels import Schedule
from fmtorch.geometry.rank2_manifold_kernels import gauss_newton, response
from fmtorch.geometry.refine_kernels import refine
from fmtorch.geometry.residual_kernels import SAMPSON, Residual
from fmtorch.geometry.sampson_objective_kernels import LOSSES, NO_TABLE, Weighted, loss_table
from fmtorch.geometry.seven_point_kernels import seven_point

SQUARINGS = 1  # by which models are made rank 2, whose last singular value is but rounding of float32
STEP_DAMPING = 1e-10  # of a Gauss-Newton step at an optimum: bounds it where the points leave a direction open


class Fundamental:
    """Matrices of rank 2. size: matches of a minimal sample; solutions: models of one sample, at most."""

    model: ClassVar[str] = "fundamental"
    residual: ClassVar[Residual] = SAMPSON
    fit_scale: ClassVar[FitScale] = FitScale()
    size: ClassVar[int]
    solutions: ClassVar[int]
    minimal: ClassVar[Callable[..., int]]

    def solve(self, pair: Pair, sample: Array, start: int) -> Hypotheses:
        """As `Family.solve`."""
        F = np.empty((sample.shape[1] * self.solutions, 9), np.float32)
        draw = np.empty(len(F), np.int64)
        count = type(self).minimal(pair.points, sample, F, draw)
        return Hypotheses(F[:count], draw[:count], sample, start)

    def to_pixels(self, F: Array, pair: Pair, out: Array) -> bool:
        """As `Estimated.to_pixels`, the entry of largest magnitude positive."""
        return to_pixels(F, pair.centre, pair.pixels_per_unit, out)

    def refine(self, F: Array, pair: Pair, loss: Loss, steps: Steps) -> Array:
        """As `Refining.refine`."""
        s2 = np.square(loss.scale / pair.pixels_per_noise)
        refined, cost = np.empty_like(F), np.empty(len(F))
        matches = Weighted(pair.points, pair.weight, s2, LOSSES[loss.name], loss_table(loss.name))
        schedule = Schedule(steps.iterations, steps.damping, steps.tolerance or 0.0)
        refine(F, SQUARINGS, matches, schedule, refined, cost)
        return np.where(np.isfinite(cost)[:, None], refined, F)

    def least_squares(self, F: Array, pair: Pair, weight: Array) -> Array:
        """As `Refining.least_squares`: the normalised 8-point algorithm."""
        fitted = np.empty(9)
        return fitted if weighted_eight_point(pair.points, weight, fitted) else F

    def step(self, F: Array, pair: Pair, weight: Array) -> Array:
        """As `Refining.step`."""
        moved = np.empty(9)
        gauss_newton(F, _squared_error(pair, weight), STEP_DAMPING, moved)
        return moved if np.isfinite(moved).all() else F


class SevenPoint(Fundamental):
    """Up to three models from seven matches."""

    size, solutions, minimal = 7, 3, seven_point


class EightPoint(Fundamental):
    """One model from eight matches."""

    size, solutions, minimal = 8, 1, eight_point


def _squared_error(pair: Pair, weight: Array) -> Weighted:
    """Weighted matches, whose errors are squared without bound."""
    return Weighted(pair.points, weight, np.full(pair.count, np.inf), LOSSES["truncated"], NO_TABLE)


def response_of(F: Array, pair: Pair, weight: Array) -> Array:
    """How the optimum F (9,) moves with the gradient of its cost, (9, 9): minus the inverse Hessian."""
    inverse = np.empty((9, 9))
    response(F, _squared_error(pair, weight), STEP_DAMPING, inverse)
    return inverse if np.isfinite(inverse).all() else np.zeros((9, 9))
