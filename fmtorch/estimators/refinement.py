"""From the pool to the estimate: its models made better, one of them selected, and fitted to its inliers.

A fit has a value, computed here without a graph, and a gradient, which `gradients` attaches to it: so the estimate has
the same bits whether anybody asks for gradients or not."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from fmtorch.core.options import Within
from fmtorch.estimators.inliers import MIN_PRIOR_FOR_NOISE, fit_distance, squared_in_noises
from fmtorch.estimators.models.fundamental import FitScale, Matrices
from fmtorch.estimators.models.posterior import Cameras, Limits
from fmtorch.estimators.models.with_focals import FundamentalWithFocals
from fmtorch.estimators.pair import Pair, squared
from fmtorch.estimators.preselection import Count, NonNegative, first_shuffled
from fmtorch.estimators.scores import Score, scored
from fmtorch.estimators.search import Pool
from fmtorch.geometry.epipolar import Residual
from fmtorch.geometry.levenberg_marquardt import Schedule
from fmtorch.jit.kernel import Array, F4x2, I8x1, Kernel, kernel
from fmtorch.jit.random import Stream

Pixels = Annotated[float, Within(0, exclusive=True)]


@dataclasses.dataclass(frozen=True)
class Refine:
    """Levenberg-Marquardt of the robust Sampson error, from each model of the pool.

    loss: a name of `geometry.LOSSES`. scale: its scale, Sampson distance, px. iterations: steps. matches: at most so
    many are looked at, drawn by the pair's key from those within RADIUS scales of a model of the pool; None: all."""

    loss: Literal["huber", "cauchy", "geman_mcclure", "truncated", "magsac"]
    scale: Pixels = 1.0
    iterations: NonNegative = 5
    matches: Count | None = None

    RADIUS = 4.0  # scales: a match farther from all models of the pool is not looked at again


@dataclasses.dataclass(frozen=True)
class Select:
    """Which refined model is the estimate: that of the largest score.

    score: a name of `PARTS`, or a score. scale: of it, Sampson distance, px. own_noise: the choice is made again
    with so many standard deviations of the noise of the matches near the first for a scale; None: it is made once."""

    score: Any = "saturated"
    scale: Pixels = 1.0
    own_noise: Pixels | None = None


LocalOptimization = Callable[[Array, Pair], Array]
"""Improves the models (k, 9) of a small pool, float64; none comes back with a lower score than it had."""


class Candidates(NamedTuple):
    """The models of a pool, refined: F (m, 9) float64; whether there are any; the matches they were refined on."""

    F: Array
    valid: bool
    near: Pair


@dataclasses.dataclass(frozen=True)
class Refinement:
    """Local optimisation of each model on its inliers, then Levenberg-Marquardt on the matches near the pool.
    options: of the latter; None: none. local_optimization: None: none."""

    options: Refine | None
    local_optimization: LocalOptimization | None = None

    def near(self, pool: Pool, pair: Pair) -> Pair:
        """The pair with the matches on which the pool's models are refined: at most so many of those within reach.
        Which of them, the pair's key decides."""
        if self.options is None or self.options.matches is None:
            return pair
        limit = np.float32(squared(self.options.RADIUS * self.options.scale / pair.pixels_per_unit))
        index = np.empty(min(self.options.matches, pair.count), np.int64)
        seed = pair.mixed_seed(Stream.REFINEMENT)
        count = near_of(pair.residual)(pool.F[: pool.filled], pair.points32, limit, seed, pair.key, index)
        return pair.take(index[:count])

    def __call__(self, pool: Pool, pair: Pair, family: Matrices) -> Candidates:
        F, near = pool.models, self.near(pool, pair)
        if self.local_optimization is not None:
            F = self.local_optimization(F, pair)
        if (options := self.options) is not None:
            F = family.refine(F, near, options.loss, options.scale, Schedule(options.iterations))
        return Candidates(F, pool.filled > 0, near)


@functools.cache
def near_of(residual: Residual) -> Kernel[..., int]:
    """The kernel that looks for matches near models, for a residual."""
    within = residual.within

    @kernel(name=f"near_{residual.name}")
    def near(F: F4x2, points: F4x2, limit: np.float32, mixed_seed: int, key: int, out: I8x1) -> int:
        """Points (4, n) within a squared residual of one of the models (k, 9), the first in a random order -> out.
        How many they are. Nothing is near a model of zeros."""
        x0, y0, x1, y1 = points[0], points[1], points[2], points[3]
        wanted = np.zeros(points.shape[1], np.bool_)
        for k in range(len(F)):
            f = (F[k, 0], F[k, 1], F[k, 2], F[k, 3], F[k, 4], F[k, 5], F[k, 6], F[k, 7], F[k, 8])
            zero = True
            for q in range(9):
                zero = zero and F[k, q] == 0
            for i in range(0 if zero else len(wanted)):
                wanted[i] |= within(f, x0[i], y0[i], x1[i], y1[i], limit)
        index, count = np.empty(len(wanted), np.int64), 0
        for i in range(len(wanted)):
            index[count] = i
            count += wanted[i]
        return first_shuffled(index[:count], mixed_seed, key, out)

    return near


class Selection(NamedTuple):
    """The selected model (9,), float64, whether there is one, and its cameras (1, ...), None where none are assumed."""

    F: Array
    valid: bool
    cameras: Cameras | None = None


class BestScore:
    """The model of the largest score.

    No scale suits all pairs: keypoints of a sharp video lie within a fifth of a pixel of their epipolar lines, those of
    learned features within one. So with `at_noise`, the score at the noise of a pair by the matches near a model (9,),
    the choice is made a second time, at the noise of the first."""

    def __init__(self, score: Score, at_noise: Callable[[Array, Pair], Score] | None = None) -> None:
        self.score, self.at_noise = score, at_noise

    def __call__(self, candidates: Candidates, pair: Pair) -> Selection:
        first = self.first(candidates, pair)
        return first if self.at_noise is None else _largest(self.of_pair(first.F, pair), candidates, pair)

    def first(self, candidates: Candidates, pair: Pair) -> Selection:
        """The model of the largest score at its own scale."""
        return _largest(self.score, candidates, pair)

    def of_pair(self, F: Array, pair: Pair) -> Score:
        """The score of the second choice, near a model (9,) of the first."""
        return self.score if self.at_noise is None else self.at_noise(F, pair)


def _largest(score: Score, candidates: Candidates, pair: Pair) -> Selection:
    return Selection(candidates.F[int(np.argmax(scores_of(score, candidates.F, pair)))], candidates.valid)


def scores_of(score: Score, F: Array, pair: Pair) -> Array:
    """Scores (k,) of models (k, 9), float64, on all matches."""
    return scored(score, F.astype(np.float32), np.arange(len(F)), pair)


# Final fits: from the selected model and its inliers to the estimate, in normalised units

SCHEDULE = Schedule(iterations=8, damping=1e-6, tolerance=1e-4)  # small damping, since the start is near the optimum
PRIOR_CONFLICT_GAIN = 4.0  # what an optimum without prior may gain, in logarithms of the likelihood, before it is taken
DOUBTFUL_GAIN = 2.0  # the same, before models without prior are searched, and lenses
FOCAL_ITERATIONS = 5  # Levenberg-Marquardt steps where cameras are assumed: these start nearer
FOCAL_TOLERANCE = 0.05  # of the logarithm of the posterior: a fifth of a standard deviation more or less


class LensFit(NamedTuple):
    """Cameras (1, ...), their lenses (2,) and the model (9,), its cost with derivatives by five rotations, two focal
    lengths and two lenses, log evidence up to a constant, the inverse Hessian, and deviations (2,) of the lenses."""

    cameras: Cameras
    lens: Array
    F: Array
    cost: float
    gradient: Array
    hessian: Array
    evidence: float
    inverse: Array
    deviation: Array


class Fit(NamedTuple):
    """A fit's value, and what its gradient depends on.
    F: (9,), the estimate. at: (9,), the model at which the gradient is taken. counted: (n,), how much each match counts
    there: 1, or 0 beyond a truncated loss. cameras: those assumed at the optimum. precision: one over the variance of
    an inlier's distance, in the unit of the points, where cameras are assumed. s2: (n,), squared scales of Cauchy's
    loss in that unit, where it is the fit's. lens: of photographs that are bent, its last fit. gain: of the logarithm
    of the likelihood without the prior on cameras that nobody calibrated."""

    F: Array
    at: Array
    counted: Array
    cameras: Cameras | None = None
    precision: float = 0.0
    s2: Array | None = None
    lens: LensFit | None = None
    gain: float = 0.0


class NoFit:
    """The selected model as it is.
    gradient: how gradients reach points, prior and noise: "none", "least_squares" of the matches that count, or
    "optimum", by the implicit function theorem. weighted: whether these matches count by prior and noise."""

    gradient: str = "none"
    weighted: bool = False

    def __call__(self, selection: Selection, pair: Pair, inliers: Array, family: Matrices) -> Fit:
        return Fit(selection.F, selection.F, inliers.astype(np.float64))


class LeastSquares(NoFit):
    """Least squares on the inliers, the normalised 8-point algorithm; the hypothesis where they determine none.
    Where there is a prior, an inlier counts prior / noise^2, as in the other fits, and gradients reach the prior; where
    there is none, all count alike."""

    gradient, weighted = "least_squares", True

    def __call__(self, selection: Selection, pair: Pair, inliers: Array, family: Matrices) -> Fit:
        weight = np.where(inliers, pair.weight if self.weighted and pair.prior is not None else 1.0, 0.0)
        return Fit(family.least_squares(selection.F, pair, weight), selection.F, inliers.astype(np.float64))


class UnweightedLeastSquares(LeastSquares):
    """The normalised 8-point algorithm on the inliers, which all count alike."""

    weighted = False


class GaussNewton(NoFit):
    """One Gauss-Newton step of the Sampson error at the selected model, on its inliers, by prior and noise."""

    gradient, weighted = "optimum", True

    def __call__(self, selection: Selection, pair: Pair, inliers: Array, family: Matrices) -> Fit:
        weight = np.where(inliers, pair.weight, 0.0)
        return Fit(family.step(selection.F, pair, weight), selection.F, inliers.astype(np.float64))


class Adaptive(NoFit):
    """Levenberg-Marquardt of the truncated Sampson error at the noise of the inliers.

    One threshold does not suit all pairs: keypoints of a sharp video lie within a fifth of a pixel of their epipolar
    lines, those of a hand-held telephone within one. A threshold for the worst lets wrong matches into the fit of the
    best. Where cameras are assumed it maximises the posterior, unless the matches contradict the prior. The noise is
    1.4826 times the median Sampson distance of the inliers (Rousseeuw & Leroy 1987), the truncation twice that;
    `FitScale` says what they are of homographies."""

    gradient, weighted = "optimum", True

    def __call__(self, selection: Selection, pair: Pair, inliers: Array, family: Matrices) -> Fit:
        likely = inliers if pair.prior is None else inliers & (pair.prior > MIN_PRIOR_FOR_NOISE)
        own = family.fit_scale
        scale, gain = fit_distance(squared_in_noises(selection.F, pair)[likely], own), 0.0
        if selection.cameras is not None:
            precision = squared(pair.pixels_per_unit / (scale / own.scale_sigmas))
            limits = Limits(precision, FOCAL_ITERATIONS, FOCAL_TOLERANCE)
            F, cameras, gain = FundamentalWithFocals().fit(selection.cameras, pair, scale, limits)
            gain = 0.0 if pair.calibration is not None else gain
            if gain <= PRIOR_CONFLICT_GAIN and all(map(math.isfinite, F.tolist())):
                return Fit(F, F, within(F, pair, scale), cameras, precision, gain=gain)
        (F,) = family.refine(selection.F[None], pair, own.loss, scale, SCHEDULE)
        if own.loss == "cauchy":
            return Fit(F, F, np.ones(pair.count), s2=np.square(scale / pair.pixels_per_noise))
        return Fit(F, F, within(F, pair, scale), gain=gain)


def within(F: Array, pair: Pair, scale: float) -> Array:
    """One for each match (n,) within so many pixels, of matches of usual noise; zero beyond."""
    return (squared_in_noises(F, pair) <= squared(scale)).astype(np.float64)


def scale_of(fit: Fit, pair: Pair) -> float:
    """The Sampson distance of a match of usual noise from which on it did not count in a fit, px."""
    if fit.cameras is not None:
        return FitScale().scale_sigmas * pair.pixels_per_unit / math.sqrt(fit.precision)
    r2 = squared_in_noises(fit.F, pair)[fit.counted > 0]
    return math.sqrt(float(r2.max())) if len(r2) else math.nan
