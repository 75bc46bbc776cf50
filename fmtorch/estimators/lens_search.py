"""The lenses of a pair before its search: rounds among plausible cameras at a few lenses, refined with the lens.

Points undistorted by one lens are a pair like any other, and from a lens within some 0.1 of the right one the
refinement finds that. Whether a lens is straight the posterior decides, a spike at zero against a normal tail, by
Laplace's approximation: freedom costs its determinant.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fmtorch.estimators.final_fits import FOCAL_TOLERANCE, MIN_PRIOR_FOR_NOISE, fit_distance
from fmtorch.estimators.focal_search import FocalSearch
from fmtorch.estimators.models.focal_prior import MIN_DEVIATION
from fmtorch.estimators.models.model import FitScale
from fmtorch.estimators.models.posterior import Cameras, Limits, centred, images_of, tangents_of, translate
from fmtorch.estimators.models.with_lenses import (
    PARAMETERS,
    LensOptimum,
    LensPrior,
    half_diagonals,
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
CANDIDATES = 4  # of a round, from which lenses are refined
START_SCALE_PX = 3.0  # beyond which matches do not count where the lens may be off
START_ITERATIONS, ITERATIONS = 12, 8


class LensFit(NamedTuple):
    """Cameras (1, ...), their lenses (2,) and the model (9,), its cost with derivatives by PARAMETERS, the logarithm of
    its evidence up to a constant, and the standard deviations (2,) of the lenses."""

    cameras: Cameras
    lens: Array
    F: Array
    cost: float
    gradient: Array
    hessian: Array
    evidence: float
    deviation: Array


def _inverse(A: Array) -> tuple[Array, float]:
    """The inverse (n, n) by elimination, whose operations are rounded alike everywhere, and log |det A|.
    Of a matrix without an inverse these are infinite and not a number."""
    n, logarithm = len(A), 0.0
    rows = np.hstack([A, np.eye(n)])
    for i in range(n):
        pivot = rows[i, i]
        if not (math.isfinite(pivot) and pivot):
            return np.full((n, n), math.inf), math.nan
        logarithm += float(logarithm_kernel(abs(float(pivot))))
        rows[i] /= pivot
        others = np.arange(n) != i
        rows[others] -= rows[others, i, None] * rows[i]
    return rows[:, n:], logarithm


def fit_with_lenses(
    cameras: Cameras, lens: Array, prior: LensPrior, pair: Pair, scale_px: float, iterations: int
) -> list[LensFit]:  # fmt: skip
    """The maxima a posteriori of the truncated error near candidates, cameras (k, ...) and lenses (k, 2).
    scale_px: from which on matches do not count; of the pair as it was photographed."""
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
        inverse, determinant = _inverse(out.hessian[i])
        normaliser = sum(float(logarithm_kernel(p)) for p in prior.precision[: 1 if prior.shared else 2])
        evidence = -float(out.cost[i]) - determinant / 2 + normaliser / 2
        variances = inverse.diagonal()[[7, 7 if prior.shared else 8]]
        cost, deviation = float(out.cost[i]), np.sqrt(np.abs(variances))
        fits.append(LensFit(own.of(i), out.lens[i], F[i], cost, out.gradient[i], out.hessian[i], evidence, deviation))
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
