"""Fundamental matrices without assumptions: samples of seven or eight matches, refined on the manifold of rank 2."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from fmtorch.compiling.arrays import Array
from fmtorch.estimators.families.family import STEP_DAMPING, FitScale, Matrices, squared_error
from fmtorch.estimators.pair import Pair, to_pixels
from fmtorch.geometry.eight_point_kernels import eight_point, weighted_eight_point
from fmtorch.geometry.levenberg_marquardt_kernels import Schedule
from fmtorch.geometry.rank2_manifold_kernels import gauss_newton, response
from fmtorch.geometry.refine_kernels import refine
from fmtorch.geometry.residual_kernels import SAMPSON, Residual
from fmtorch.geometry.sampson_objective_kernels import Weighted
from fmtorch.geometry.seven_point_kernels import seven_point

SQUARINGS = 1  # by which models are made rank 2, whose last singular value is but rounding of float32


class Fundamental(Matrices):
    """Matrices of rank 2."""

    model: ClassVar[str] = "fundamental"
    residual: ClassVar[Residual] = SAMPSON
    fit_scale: ClassVar[FitScale] = FitScale()
    linear, gauss_newton = weighted_eight_point, gauss_newton

    def to_pixels(self, F: Array, pair: Pair, out: Array) -> bool:
        """As `Estimated.to_pixels`, the entry of largest magnitude positive."""
        return to_pixels(F, pair.centre, pair.pixels_per_unit, out)

    def minimise(self, F: Array, matches: Weighted, schedule: Schedule, out: Array, cost: Array) -> None:
        """As `Matrices.minimise`."""
        refine(F, SQUARINGS, matches, schedule, out, cost)


class SevenPoint(Fundamental):
    """Up to three models from seven matches."""

    size, solutions, minimal = 7, 3, seven_point


class EightPoint(Fundamental):
    """One model from eight matches."""

    size, solutions, minimal = 8, 1, eight_point


def response_of(F: Array, pair: Pair, weight: Array) -> Array:
    """How the optimum F (9,) moves with the gradient of its cost, (9, 9): minus the inverse Hessian."""
    inverse = np.empty((9, 9))
    response(F, squared_error(pair, weight), STEP_DAMPING, inverse)
    return inverse if np.isfinite(inverse).all() else np.zeros((9, 9))
