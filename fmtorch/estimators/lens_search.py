"""The lenses of a pair before its search: rounds among plausible cameras at a few lenses, refined with the lens.

Points undistorted by one lens are a pair like any other, and from a lens within some 0.1 of the right one the
refinement finds that. Whether a lens is straight the posterior decides, a spike at zero against a normal tail, by
Laplace's approximation: freedom costs its determinant.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fmtorch.estimators.final_fits import FOCAL_TOLERANCE, MIN_PRIOR_FOR_NOISE, Fit, fit_distance
from fmtorch.estimators.focal_search import FocalSearch
from fmtorch.estimators.models.focal_prior import MIN_DEVIATION
from fmtorch.estimators.models.model import FitScale
from fmtorch.estimators.models.posterior import (
    Cameras,
    Limits,
    centred,
    images_of,
    nearest_cameras,
    no_cameras,
    tangents_of,
    translate,
)
from fmtorch.estimators.models.with_lenses import (
    PARAMETERS,
    LensOptimum,
    LensPrior,
    half_diagonals,
    inverted,
    minimise_with_lenses,
    photograph_residuals,
    undistorted,
)
from fmtorch.estimators.pair import Lens, Pair, squared
from fmtorch.geometry.arithmetic import logarithm_kernel
from fmtorch.geometry.levenberg_marquardt import LOSS_CODES, NO_TABLE, Weighted
from fmtorch.jit.kernel import Array
from fmtorch.jit.lanes import LANES

STARTS = ((0.0, 0.0), (-0.12, -0.12), (-0.25, -0.25))  # of both lenses, where they are one
OWN_STARTS = (*STARTS, (0.0, -0.2), (-0.2, 0.0))  # where each has its own
TAIL_DEVIATION = 0.15  # of an unknown lens that is not straight
LENS = 7  # the first of the lenses among PARAMETERS
# A Newton step from pinholes that makes these suspicious, also in standard deviations at START_SCALE_PX, and an optimum
# that is suggested. On castle-P19 and fox these suggest a lens for 1 of 172 pairs where there is none, and where it is
# -0.1 for 80 of the 101 pairs that have 100 right matches across half of the images.
SUSPICIOUS_LENS, SUSPICIOUS_DEVIATIONS = 0.02, 0.4
SUGGESTED_LENS, SUGGESTED_DEVIATIONS, SUGGESTED_GAIN = 0.03, 3.0, 2.0
CANDIDATES = 4  # of a round, from which lenses are refined
START_SCALE_PX = 3.0  # beyond which matches do not count where the lens may be off
START_ITERATIONS, ITERATIONS = 12, 8


class LensFit(NamedTuple):
    """Cameras (1, ...), their lenses (2,) and the model (9,), its cost with derivatives by PARAMETERS, the logarithm of
    its evidence up to a constant, the inverse of the Hessian, and the standard deviations (2,) of the lenses."""

    cameras: Cameras
    lens: Array
    F: Array
    cost: float
    gradient: Array
    hessian: Array
    evidence: float
    inverse: Array
    deviation: Array


def fit_with_lenses(
    cameras: Cameras, lens: Array, prior: LensPrior, pair: Pair, scale_px: float, iterations: int
) -> list[LensFit]:  # fmt: skip
    """The maxima a posteriori of the truncated error near candidates, cameras (k, ...) and lenses (k, 2).

    scale_px: from which on matches do not count; of the pair as it was photographed.
    """
    k, matches, images, own = len(lens), centred(pair, scale_px), images_of(pair), cameras.copy()
    out = LensOptimum(
        lens.copy(), np.empty((k, 9)), np.empty(k), np.empty((k, PARAMETERS)), np.empty((k, PARAMETERS, PARAMETERS))
    )
    weighted = Weighted(matches.points, pair.weight, matches.s2, LOSS_CODES["truncated"], NO_TABLE)
    limits = Limits(squared(pair.pixels_per_unit / (scale_px / FitScale().scale_sigmas)), iterations, FOCAL_TOLERANCE)
    minimise_with_lenses(own, weighted, images, prior._replace(diagonal=half_diagonals(pair)), limits, out)
    F = np.empty((k, 9))
    translate(out.F, images.offset, F)
    F /= np.sqrt((F * F).sum(1, keepdims=True))
    fits = []
    for i in range(k):
        inverse = np.empty((PARAMETERS, PARAMETERS))
        determinant = inverted(out.hessian[i], inverse)
        normaliser = sum(float(logarithm_kernel(p)) for p in prior.precision[: 1 if prior.shared else 2])
        evidence = -float(out.cost[i]) - determinant / 2 + normaliser / 2
        deviation = np.sqrt(np.abs(inverse.diagonal()[[LENS, LENS if prior.shared else LENS + 1]]))
        at = float(out.cost[i]), out.gradient[i], out.hessian[i]
        fits.append(LensFit(own.of(i), out.lens[i], F[i], *at, evidence, inverse, deviation))
    return fits


def squared_px(model: Array, lens: Array, pair: Pair) -> Array:
    """Squared residuals (n,) in squared pixels of the photographs, of a model (9,) and lenses (2,)."""
    images, F, r2 = images_of(pair), np.empty((1, 9)), np.empty(pair.count)
    translate(model[None], -images.offset, F)
    photograph_residuals(F[0], lens, half_diagonals(pair), centred(pair).points, r2)
    return r2 * squared(pair.pixels_per_unit)


def noise_scale(fit: LensFit, pair: Pair) -> float:
    """From which Sampson distance on matches do not count, px, by the noise of those that lie within the start's."""
    r2 = squared_px(fit.F, fit.lens, pair) / np.square(pair.noises)
    likely = (r2 <= squared(START_SCALE_PX)) & (pair.match_weight > MIN_PRIOR_FOR_NOISE)
    return fit_distance(r2[likely], FitScale())


def lens_prior(lens: Lens) -> LensPrior:
    """The prior of the refinement: normal, of unknown lenses the tail."""
    deviation = np.clip(lens.deviations, MIN_DEVIATION, TAIL_DEVIATION)
    return LensPrior(np.array(lens.means), 1 / np.square(deviation), lens.shared)


STRAIGHT = Lens((0.0, 0.0), (0.0, 0.0), True)
SHARED = Lens((0.0, 0.0), (math.inf, math.inf), True)


def lenses_of(pair: Pair, search: FocalSearch) -> Array:
    """The lenses (2,) of a pair that has some, as its matches tell them; those that are exactly known as they are."""
    lens = pair.lens
    assert lens is not None
    mean, unknown = np.array(lens.means), np.isinf(lens.deviations)
    if max(lens.deviations) < MIN_DEVIATION:
        return mean
    prior, fits = lens_prior(lens), list[LensFit]()
    for start in STARTS if lens.shared else OWN_STARTS:
        fits += _round(np.where(unknown, start, mean), prior, pair, search)
    if not fits:
        return mean
    scale = noise_scale(min(fits, key=lambda fit: fit.cost), pair)
    best = _best(fits, prior, pair, scale)
    if unknown.all():
        straight, none = lens_prior(STRAIGHT), np.zeros(2)
        pinholes = [_from(fit._replace(lens=none), straight, pair, START_SCALE_PX, START_ITERATIONS) for fit in fits]
        if not best.evidence > _best(pinholes, straight, pair, scale).evidence:
            return mean
    return best.lens


def _round(at: Array, prior: LensPrior, pair: Pair, search: FocalSearch) -> list[LensFit]:
    """The best of a round's candidates, of pinholes at these lenses (2,), refined with the lenses; one, or none."""
    candidates, _ = search.round(undistorted(pair, at), 0)
    best = np.argsort(-candidates.posterior, kind="stable")[:CANDIDATES]
    best = best[np.isfinite(candidates.posterior[best])]
    cameras = Cameras(candidates.cameras.axes[best], candidates.cameras.focal[best])
    lenses = np.tile(at, (len(best), 1))
    found = fit_with_lenses(cameras, lenses, prior, pair, START_SCALE_PX, START_ITERATIONS)
    return sorted((fit for fit in found if math.isfinite(fit.cost)), key=lambda fit: fit.cost)[:1]


def _from(fit: LensFit, prior: LensPrior, pair: Pair, scale_px: float, iterations: int) -> LensFit:
    """The fit near another one."""
    return fit_with_lenses(fit.cameras, fit.lens[None], prior, pair, scale_px, iterations)[0]


def _best(fits: list[LensFit], prior: LensPrior, pair: Pair, scale: float) -> LensFit:
    """The fit of greatest evidence at a scale near these."""
    return max((_from(fit, prior, pair, scale, ITERATIONS) for fit in fits), key=lambda fit: fit.evidence)


def lens_fit(lens: Array, cameras: Cameras, pair: Pair, inliers: Array) -> LensFit:
    """The last fit of a selected model's cameras (1, ...) and lenses (2,), at the noise of its inliers (n,)."""
    assert pair.lens is not None
    likely = inliers & (pair.match_weight > MIN_PRIOR_FOR_NOISE)
    r2 = (squared_px(_model(cameras, pair), lens, pair) / np.square(pair.noises))[likely]
    (fit,) = fit_with_lenses(cameras, lens[None], lens_prior(pair.lens), pair, fit_distance(r2, FitScale()), ITERATIONS)
    return fit


def _model(cameras: Cameras, pair: Pair) -> Array:
    """The model (9,) of cameras (1, ...), of unit norm."""
    F, out, images = np.empty((1, 9)), np.empty((1, 9)), images_of(pair)
    tangents_of(cameras, images.longest, F, np.zeros((1, 9, LANES)))
    translate(F, images.offset, out)
    unit: Array = out[0] / math.sqrt((out[0] * out[0]).sum())
    return unit


def suggested_lens(fit: Fit, pair: Pair) -> float:
    """One lens for both images with which the matches agree where they contradict the pinholes of a fit, or NaN.

    One Newton step of all unknowns says whether to look for it, in a fraction of a search's time.
    """
    cameras = fit.cameras
    if cameras is None:
        cameras = no_cameras(1)
        nearest_cameras(fit.F[None], images_of(pair), cameras)
    none, unknown, straight = np.zeros((1, 2)), lens_prior(SHARED), lens_prior(STRAIGHT)
    (pinholes,) = fit_with_lenses(cameras, none, unknown, pair, START_SCALE_PX, 0)
    step = abs(float((pinholes.inverse[LENS] * pinholes.gradient).sum()))
    if not step > max(SUSPICIOUS_LENS, SUSPICIOUS_DEVIATIONS * pinholes.deviation[0]):
        return math.nan

    def refined(start: LensFit, prior: LensPrior) -> LensFit:
        return _from(start, prior, pair, START_SCALE_PX, START_ITERATIONS)

    fits = [refined(pinholes._replace(lens=np.array(start)), unknown) for start in STARTS]
    scale = noise_scale(min(fits, key=lambda fit: fit.cost), pair)
    best, without = _best(fits, unknown, pair, scale), _best([refined(pinholes, straight)], straight, pair, scale)
    lens, deviation = float(best.lens[0]), float(best.deviation[0])
    clear = abs(lens) > max(SUGGESTED_LENS, SUGGESTED_DEVIATIONS * deviation)
    return lens if clear and best.evidence - without.evidence > SUGGESTED_GAIN else math.nan
