"""`final_fits` on the arrays of one pair: values; gradients are the tensor form's."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from fmtorch.estimators import final_fits
from fmtorch.estimators.final_fits import (
    DAMPING,
    FOCAL_ITERATIONS,
    FOCAL_TOLERANCE,
    ITERATIONS,
    MIN_INLIERS_FOR_NOISE,
    MIN_PRIOR_FOR_NOISE,
    PRIOR_CONFLICT_GAIN,
    TOLERANCE,
    TRUNCATION_SIGMAS,
)
from fmtorch.estimators.one_pair.focal.cameras import UNKNOWN, TwoCameras
from fmtorch.estimators.one_pair.focal.fit import fit_focal
from fmtorch.estimators.one_pair.inliers import median_of_matches, residuals_squared_px, within_px
from fmtorch.estimators.one_pair.pair import Array, OnePair, squared
from fmtorch.estimators.one_pair.refine import gauss_newton_step, refine_models
from fmtorch.estimators.one_pair.selection import Selection
from fmtorch.geometry.eight_point_kernels import weighted_eight_point
from fmtorch.geometry.refine import RANK_TWO_ALREADY


class Fit(NamedTuple):
    """As `final_fits.Fit`: F (3, 3), the model (3, 3) at which the gradient is taken, the matches (n,) that count."""

    F: Array
    at: Array
    counted: Array
    cameras: TwoCameras | None = None
    truncation: float | None = None


@runtime_checkable
class FinalFit(Protocol):
    """As `final_fits.FinalFit`."""

    def value(self, selection: Selection, pair: OnePair, inliers: Array) -> Fit:
        """The estimate from the selected model and its inliers (n,)."""
        ...


class NoFit:
    """As `final_fits.NoFit`."""

    def __init__(self, part: final_fits.NoFit) -> None:
        pass

    def value(self, selection: Selection, pair: OnePair, inliers: Array) -> Fit:
        """As `FinalFit.value`."""
        return Fit(selection.matrices, selection.matrices, inliers)


class LeastSquares:
    """As `final_fits.LeastSquares`."""

    def __init__(self, part: final_fits.LeastSquares) -> None:
        self.part = part

    def value(self, selection: Selection, pair: OnePair, inliers: Array) -> Fit:
        """As `FinalFit.value`."""
        weighted = self.part.weighted and pair.prior is not None
        weight = np.where(inliers, pair.weight if weighted else 1.0, 0.0)
        F = np.empty(9)
        fitted = weighted_eight_point(pair.points, weight, F)
        return Fit(F.reshape(3, 3) if fitted else selection.matrices, selection.matrices, inliers)


class GaussNewton:
    """As `final_fits.GaussNewton`."""

    def __init__(self, part: final_fits.GaussNewton) -> None:
        pass

    def value(self, selection: Selection, pair: OnePair, inliers: Array) -> Fit:
        """As `FinalFit.value`."""
        weight = np.where(inliers, pair.weight, 0.0)
        F = gauss_newton_step(selection.F, pair.points, weight)
        return Fit(F.reshape(3, 3), selection.matrices, inliers)


class AdaptiveGaussNewton:
    """As `final_fits.AdaptiveGaussNewton`."""

    def __init__(self, part: final_fits.AdaptiveGaussNewton) -> None:
        pass

    def value(self, selection: Selection, pair: OnePair, inliers: Array) -> Fit:
        """As `FinalFit.value`."""
        F, cameras = selection.F, UNKNOWN
        likely = inliers if pair.prior is None else inliers & (pair.prior > MIN_PRIOR_FOR_NOISE)
        truncation = truncation_distance(_squared_in_noises(F, pair)[likely])
        assumed = False
        if selection.cameras.known:
            own = fit_focal(
                selection.cameras, pair, truncation, truncation / TRUNCATION_SIGMAS, FOCAL_ITERATIONS, FOCAL_TOLERANCE
            )
            assumed = own.gain <= PRIOR_CONFLICT_GAIN and all(map(math.isfinite, own.F.tolist()))
            if assumed:
                F, cameras = own.F, own.cameras
        if not assumed:
            (F,) = refine_models(
                F[None], pair, "truncated", truncation, ITERATIONS, RANK_TWO_ALREADY, TOLERANCE, DAMPING
            )
        counted = _within_noises(F, pair, truncation)
        matrix = F.reshape(3, 3)
        return Fit(matrix, matrix, counted, cameras, truncation)


def _squared_in_noises(F: Array, pair: OnePair) -> Array:
    """Squared Sampson distances (n,) in squared pixels, of matches of usual noise."""
    r2 = residuals_squared_px(F, pair)
    return r2 if pair.noise is None else r2 / np.square(pair.noise)


def _within_noises(F: Array, pair: OnePair, truncation: float) -> Array:
    """The matches (n,) within a distance that is in pixels for matches of usual noise."""
    if pair.noise is None:
        return within_px(F, pair, truncation)
    near: Array = _squared_in_noises(F, pair) <= squared(truncation)
    return near


def truncation_distance(r2: Array) -> float:
    """As `final_fits.truncation_distance`, of the inliers' squared distances."""
    if len(r2) < MIN_INLIERS_FOR_NOISE:
        return final_fits.DEFAULT_TRUNCATION_PX
    truncation = TRUNCATION_SIGMAS * 1.4826 * math.sqrt(median_of_matches(r2))
    return min(max(truncation, final_fits.MIN_TRUNCATION_PX), final_fits.MAX_TRUNCATION_PX)
