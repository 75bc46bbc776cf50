"""Final fits: from the selected model and its inliers to the estimate, in normalised units.

A fit has a value, computed here without a graph, and a gradient, which `gradients` attaches to it: so the estimate has
the same bits whether anybody asks for gradients or not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fmtorch.estimators.inliers import MIN_PRIOR_FOR_NOISE, fit_distance, squared_in_noises
from fmtorch.estimators.models.fundamental import FitScale, Matrices
from fmtorch.estimators.models.posterior import Cameras, Limits
from fmtorch.estimators.models.with_focals import FundamentalWithFocals
from fmtorch.estimators.pair import Pair, squared
from fmtorch.estimators.refinement import Selection
from fmtorch.geometry.levenberg_marquardt import Schedule
from fmtorch.jit.kernel import Array

SCHEDULE = Schedule(iterations=8, damping=1e-6, tolerance=1e-4)  # small damping, since the start is near the optimum
PRIOR_CONFLICT_GAIN = 4.0  # what an optimum without prior may gain, in logarithms of the likelihood, before it is taken
FOCAL_ITERATIONS = 5  # Levenberg-Marquardt steps where cameras are assumed: these start nearer
FOCAL_TOLERANCE = 0.05  # of the logarithm of the posterior: a fifth of a standard deviation more or less


class Fit(NamedTuple):
    """A fit's value, and what its gradient depends on.
    F: (9,), the estimate. at: (9,), the model at which the gradient is taken. counted: (n,), how much each match counts
    there: 1, or 0 beyond a truncated loss. cameras: those assumed at the optimum. precision: one over the variance of
    an inlier's distance, in the unit of the points, where cameras are assumed. s2: (n,), squared scales of Cauchy's
    loss in that unit, where it is the fit's."""

    F: Array
    at: Array
    counted: Array
    cameras: Cameras | None = None
    precision: float = 0.0
    s2: Array | None = None


class NoFit:
    """The selected model as it is.
    gradient: how gradients reach points, prior and noise: "none", "least_squares" of the matches that count, or
    "optimum", by the implicit function theorem. weighted: whether these matches count by prior and noise."""

    gradient: str = "none"
    weighted: bool = False

    def __call__(self, selection: Selection, pair: Pair, inliers: Array, family: Matrices) -> Fit:
        """The estimate from the selected model and its inliers (n,)."""
        return Fit(selection.F, selection.F, inliers.astype(np.float64))


class LeastSquares(NoFit):
    """Least squares on the inliers, the normalised 8-point algorithm; the hypothesis where they determine none.
    Where there is a prior, an inlier counts prior / noise^2, as in the other fits, and gradients reach the prior; where
    there is none, all count alike. On 60 pairs of castle-P19 and fox with the prior of frame consistency, three seeds,
    weights raise AUC@0.05 by 0.9 +- 0.4 (`ransac`), 0.9 +- 0.4 (`msac`) and 1.5 +- 0.6 points (`lmeds`, standard errors
    over pairs); without the noise by 0.4, 0.6 and 1.0."""

    gradient, weighted = "least_squares", True

    def __call__(self, selection: Selection, pair: Pair, inliers: Array, family: Matrices) -> Fit:
        """As `NoFit`."""
        weighted = self.weighted and pair.prior is not None
        weight = np.where(inliers, pair.weight if weighted else 1.0, 0.0)
        return Fit(family.least_squares(selection.F, pair, weight), selection.F, inliers.astype(np.float64))


class UnweightedLeastSquares(LeastSquares):
    """The normalised 8-point algorithm on the inliers, which all count alike."""

    weighted = False


class GaussNewton(NoFit):
    """One Gauss-Newton step of the Sampson error at the selected model, on its inliers, by prior and noise."""

    gradient, weighted = "optimum", True

    def __call__(self, selection: Selection, pair: Pair, inliers: Array, family: Matrices) -> Fit:
        """As `NoFit`."""
        weight = np.where(inliers, pair.weight, 0.0)
        return Fit(family.step(selection.F, pair, weight), selection.F, inliers.astype(np.float64))


class Adaptive(NoFit):
    """Levenberg-Marquardt of the truncated Sampson error at the noise of the inliers.

    One threshold does not suit all pairs: keypoints of a sharp video lie within a fifth of a pixel of their epipolar
    lines, those of a hand-held telephone within one. A threshold for the worst lets wrong matches into the fit of the
    best: on rendered training scenes this fit raises AUC@0.05 from 66.8 to 74.2 (indoor) and from 78.2 to 85.3
    (driving) and changes nothing on castle-P19 and fox.
    Where cameras are assumed it maximises the posterior, unless the matches contradict the prior. The noise is 1.4826
    times the median Sampson distance of the inliers (Rousseeuw & Leroy 1987), the truncation twice that; `FitScale`
    says what they are of homographies.
    """

    gradient, weighted = "optimum", True

    def __call__(self, selection: Selection, pair: Pair, inliers: Array, family: Matrices) -> Fit:
        """As `NoFit`."""
        likely = inliers if pair.prior is None else inliers & (pair.prior > MIN_PRIOR_FOR_NOISE)
        own = family.fit_scale
        scale = fit_distance(squared_in_noises(selection.F, pair)[likely], own)
        if selection.cameras is not None:
            precision = squared(pair.pixels_per_unit / (scale / own.scale_sigmas))
            limits = Limits(precision, FOCAL_ITERATIONS, FOCAL_TOLERANCE)
            F, cameras, gain = FundamentalWithFocals().fit(selection.cameras, pair, scale, limits)
            agreed = pair.calibration is not None or gain <= PRIOR_CONFLICT_GAIN
            if agreed and all(map(math.isfinite, F.tolist())):
                return Fit(F, F, within(F, pair, scale), cameras, precision)
        (F,) = family.refine(selection.F[None], pair, own.loss, scale, SCHEDULE)
        if own.loss == "cauchy":
            return Fit(F, F, np.ones(pair.count), s2=np.square(scale / pair.pixels_per_noise))
        return Fit(F, F, within(F, pair, scale))


def within(F: Array, pair: Pair, scale: float) -> Array:
    """One for each match (n,) within so many pixels, of matches of usual noise; zero beyond."""
    return (squared_in_noises(F, pair) <= squared(scale)).astype(np.float64)


def scale_of(fit: Fit, pair: Pair) -> float:
    """The Sampson distance of a match of usual noise from which on it did not count in a fit, px."""
    if fit.cameras is not None:
        return FitScale().scale_sigmas * pair.pixels_per_unit / math.sqrt(fit.precision)
    r2 = squared_in_noises(fit.F, pair)[fit.counted > 0]
    return math.sqrt(float(r2.max())) if len(r2) else math.nan
