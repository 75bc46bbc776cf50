"""Cameras whose lenses bend straight lines: the division model, refined with the cameras, judged in the photograph.

``x_u = x_d / (1 + lambda |x_d|^2)`` (Fitzgibbon, CVPR 2001), from the principal point, in half diagonals of the image:
0 of a pinhole, -0.05 of a usual phone, -0.3 of an action camera. In homogeneous coordinates ``h = (x, y, 1 + lambda
r^2)`` the epipolar constraint is a polynomial, ``h1^T F h0 = 0``, whose Sampson distance by the photograph's own
coordinates needs no undistorted point (the tangent Sampson error of Terekhov & Larsson, ICCV 2023)."""

import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.core.types import MAX_LENS, MIN_LENS
from fmtorch.estimators.focal_search import FocalSearch
from fmtorch.estimators.inliers import MIN_PRIOR_FOR_NOISE, fit_distance, noise_scale
from fmtorch.estimators.models import posterior
from fmtorch.estimators.models.focal_prior import MIN_DEVIATION, focal_cost
from fmtorch.estimators.models.fundamental import FitScale
from fmtorch.estimators.models.posterior import Cameras, Images, Limits, centred, images_of, tangents_of, translate
from fmtorch.estimators.models.with_focals import gain_without_prior
from fmtorch.estimators.pair import Lens, Pair, squared
from fmtorch.estimators.refinement import DOUBTFUL_GAIN, FOCAL_TOLERANCE, PRIOR_CONFLICT_GAIN, Fit, LensFit
from fmtorch.geometry.arithmetic import logarithm_kernel
from fmtorch.geometry.epipolar import TINY
from fmtorch.geometry.levenberg_marquardt import MATCH, Rows, Weighted, in_rows, minimiser, rows_of, summation
from fmtorch.geometry.matrices import assign
from fmtorch.geometry.rank2_manifold import damped_step
from fmtorch.jit.kernel import Array, F8x1, F8x2, F8x3, F8x4, inner, kernel, matrix, vector
from fmtorch.jit.lanes import LANES, load, store, where

MIN_DEPTH = 0.1  # of a point beyond the corner
PARAMETERS, LENS = 9, 7  # five rotations, two focal lengths, two lenses, of which LENS is the first
ROWS = 12  # of a match: derivatives by nine entries and two lenses, and the residual


class LensPrior(NamedTuple):
    """What is known of the lenses of both images. mean, precision: (2,), of lambda, one over its variance. shared:
    whether there is one lens for both. diagonal: (2,), half of the images', in the unit of the points."""

    mean: F8x1
    precision: F8x1
    shared: bool
    diagonal: F8x1 = np.ones(2)


class LensOptimum(NamedTuple):
    """Of k candidates, as `Optimum`: cameras, lens (k, 2), models F (k, 9) from the principal points, costs (k,), and
    their derivatives; at the end also inverses of the Hessians, logarithms of their evidence (k,) up to a constant, and
    standard deviations of lenses (k, 2)."""

    axes: F8x4
    focal: F8x2
    lens: F8x2
    F: F8x2
    cost: F8x1
    gradient: F8x2
    hessian: F8x3
    inverse: F8x3
    evidence: F8x1
    deviation: F8x2


def half_diagonals(pair: Pair) -> Array:
    """Of both images (2,), in the unit of the points."""
    h0, w0, h1, w1 = pair.sizes.tolist()
    return np.array([math.sqrt(h0 * h0 + w0 * w0), math.sqrt(h1 * h1 + w1 * w1)]) / 2 / pair.pixels_per_unit


def undistorted(pair: Pair, lens: Array) -> Pair:
    """The pair of pinholes whose lenses (2,) are these; a match's noise grows as its points are stretched."""
    table, offset, diagonal = pair.table.copy(), images_of(pair).offset, half_diagonals(pair)
    stretch = np.zeros(pair.count)
    for k in range(2):
        x, y = table[2 * k] + offset[2 * k], table[2 * k + 1] + offset[2 * k + 1]
        bent = lens[k] * (x * x + y * y) / (diagonal[k] * diagonal[k])
        depth = np.maximum(1 + bent, MIN_DEPTH)
        table[2 * k], table[2 * k + 1] = x / depth - offset[2 * k], y / depth - offset[2 * k + 1]
        stretch += abs(1 - bent) / (depth * depth * depth) / 2
    table[4] /= stretch
    table[5] /= np.sqrt(stretch)
    table[7] *= np.sqrt(stretch)
    return pair.with_table(table, (pair.known[0], True, pair.known[2]), None)


class _Data(NamedTuple):
    """tangents: (k, 9, LANES), of the cameras; products: (ROWS, ROWS), for the work."""

    rows: Rows
    images: Images
    prior: LensPrior
    limits: Limits
    tangents: F8x3
    products: F8x2


@kernel
def minimise_with_lenses(
    state: LensOptimum, matches: Weighted, images: Images, prior: LensPrior, limits: Limits
) -> None:
    """Cameras and lenses of least negative logarithm of the posterior near these, and what it is there, in place.
    matches: of the photographs, from the principal points."""
    k = len(state.cost)
    axes, hessian = np.empty((k, 2, 3, 3)), np.empty((k, PARAMETERS, PARAMETERS))
    trial = LensOptimum(
        axes, matrix(k, 2), matrix(k, 2), matrix(k, 9), vector(k), matrix(k, PARAMETERS), hessian,
        state.inverse, state.evidence, state.deviation,
    )  # fmt: skip
    rows, tangents = rows_of(matches, ROWS), np.zeros((k, 9, LANES))
    data = _Data(rows, images, prior, limits, tangents, matrix(ROWS, ROWS))
    _minimise(data, state, trial, np.full(k, posterior.FIRST_DAMPING), limits.iterations, limits.tolerance)
    own = 1 if prior.shared else 2
    normaliser = 0.0
    for i in range(own):
        normaliser += logarithm_kernel(prior.precision[i])
    for i in range(k):
        state.evidence[i] = -state.cost[i] - _inverted(state.hessian[i], state.inverse[i]) / 2 + normaliser / 2
        for j in range(2):
            place = LENS + j * (own - 1)
            variance = abs(state.inverse[i, place, place])
            state.deviation[i, j] = math.sqrt(variance) if variance == variance else math.inf


@inner
def _inverted(A: Array, out: Array) -> Any:
    """The inverse of A (n, n) -> out, and log |det A|; not numbers where there is none."""
    n, rows, logarithm = len(A), matrix(len(A), len(A)), 0.0
    for i in range(n):
        for c in range(n):
            rows[i, c], out[i, c] = A[i, c], 1.0 if i == c else 0.0
    for i in range(n):
        pivot = rows[i, i]
        pivot = pivot if abs(pivot) < math.inf and pivot != 0 else math.nan
        logarithm += logarithm_kernel(abs(pivot))
        for c in range(n):
            rows[i, c] /= pivot
            out[i, c] /= pivot
        for r in range(n):
            factor = rows[r, i]
            if r != i:
                for c in range(n):
                    rows[r, c] -= factor * rows[i, c]
                    out[r, c] -= factor * out[i, c]
    return logarithm


@kernel(holds_gil=True)
def photograph_residuals(F: F8x1, lens: F8x1, diagonal: F8x1, points: F8x2, out: F8x1) -> None:
    """Squared Sampson distances (n,) of points (4, n) of photographs, from the principal points, of a model (9,)."""
    n, J = points.shape[1], matrix(ROWS, LANES)
    rows, r2 = in_rows(points, np.ones(n), np.ones(n)), matrix(1, LANES)
    for first in range(0, n, LANES):
        _, value = _linearised((F, lens, diagonal), rows, first // LANES * MATCH, J, 0)
        store(r2, 0, value)
        for i in range(min(LANES, n - first)):
            out[first + i] = r2[0, i]


@inner
def _evaluate(state: LensOptimum, data: _Data, derivatives: bool) -> None:
    images = data.images
    posterior.camera_models(state.axes, state.focal, images.longest, images.prior.shared, state.F, data.tangents)
    work, W = vector(5), np.zeros((ROWS - 1, PARAMETERS))
    for k in range(len(state.cost)):
        cost = summed_with_lenses(state.F[k], state.lens[k], data, derivatives) * data.limits.precision / 2
        cost += focal_cost(state.focal[k], images.prior, work)
        for i in range(1 if data.prior.shared else 2):
            away = state.lens[k, i] - data.prior.mean[i]
            cost += data.prior.precision[i] * away * away / 2
        state.cost[k] = cost
        if derivatives:
            _derivatives(state, data, k, work, W)


@kernel
def summed_with_lenses(F: F8x1, lens: F8x1, data: _Data, derivatives: bool) -> float:
    """The robust cost of one candidate; the products of derivatives and residuals -> data.products."""
    cost: float = _summed((F, lens, data.prior.diagonal), data.rows, derivatives, data.products)
    return cost


@inner
def _linearised(model: tuple[Array, Array, Array], rows: Array, row: int, J: Array, at: int) -> tuple[Any, Any]:
    """Derivatives and residual of LANES matches -> ROWS rows of J; inverse squared slopes, squared distances.
    model: F (9,), lenses, and half diagonals of the images."""
    f, lens, diagonal = model
    l0, l1 = lens[0] / (diagonal[0] * diagonal[0]), lens[1] / (diagonal[1] * diagonal[1])
    x0, y0, x1, y1 = load(rows, row), load(rows, row + 1), load(rows, row + 2), load(rows, row + 3)
    r0, r1 = x0 * x0 + y0 * y0, x1 * x1 + y1 * y1
    w0, w1 = r0 * l0 + 1.0, r1 * l1 + 1.0
    p0, q0, s0 = f[0] * x0 + f[1] * y0 + f[2] * w0, f[3] * x0 + f[4] * y0 + f[5] * w0, f[6] * x0 + f[7] * y0 + f[8] * w0
    p1, q1, s1 = f[0] * x1 + f[3] * y1 + f[6] * w1, f[1] * x1 + f[4] * y1 + f[7] * w1, f[2] * x1 + f[5] * y1 + f[8] * w1
    e = x1 * p0 + y1 * q0 + w1 * s0
    a0, b0 = p1 + x0 * s1 * (2 * l0), q1 + y0 * s1 * (2 * l0)  # slopes by the points of image 0, and of image 1
    a1, b1 = p0 + x1 * s0 * (2 * l1), q0 + y1 * s0 * (2 * l1)
    slope = a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1
    inverse = 1.0 / where(slope > TINY, slope, TINY)
    c = e * inverse
    t0, t1 = x0 * a0 + y0 * b0, x1 * a1 + y1 * b1
    c0, c1 = t0 * (2 * l0), t1 * (2 * l1)
    u, v, w = x1 - c * a1, y1 - c * b1, w1 - c * c1
    p, q, s = c * a0, c * b0, c * c0
    store(J, at, (u * x0 - x1 * p, u * y0 - x1 * q, u * w0 - x1 * s))
    store(J, at + 3, (v * x0 - y1 * p, v * y0 - y1 * q, v * w0 - y1 * s))
    store(J, at + 6, (w * x0 - w1 * p, w * y0 - w1 * q, w * w0 - w1 * s))
    store(J, at + 9, r0 * s1 - c * (2.0 * s1 * t0 + r0 * (a1 * f[2] + b1 * f[5] + c1 * f[8])))
    store(J, at + 10, (r1 * s0 - c * (2.0 * s0 * t1 + r1 * (a0 * f[6] + b0 * f[7] + c0 * f[8])), e))
    r2 = e * c
    return inverse, where(r2 == r2, r2, math.nan)


_summed = summation(_linearised, ROWS)


@inner
def _derivatives(state: LensOptimum, data: _Data, k: int, focal: Array, W: Array) -> None:
    """Gradient and Hessian of one candidate. focal: (5,), of `focal_cost`; W: (ROWS - 1, PARAMETERS), zeros or this."""
    gradient, hessian, products, prior = state.gradient[k], state.hessian[k], data.products, data.prior
    for q in range(9):
        for i in range(7):
            W[q, i] = data.tangents[k, q, i]
    W[9, 7], W[10, 7 if prior.shared else 8] = 1 / prior.diagonal[0] ** 2, 1 / prior.diagonal[1] ** 2
    for i in range(PARAMETERS):
        total = 0.0
        for q in range(ROWS - 1):
            total += W[q, i] * products[q, ROWS - 1]
        gradient[i] = total * data.limits.precision
        for j in range(PARAMETERS):
            total = 0.0
            for q in range(ROWS - 1):
                along = 0.0
                for r in range(ROWS - 1):
                    along += products[q, r] * W[r, j]
                total += W[q, i] * along
            hessian[i, j] = total * data.limits.precision
    for i in range(2):
        gradient[5 + i] += focal[i]
        for j in range(2):
            hessian[5 + i, 5 + j] += focal[2 + i] if i == j else focal[4]
        if i == 0 or not prior.shared:
            gradient[7 + i] += prior.precision[i] * (state.lens[k, i] - prior.mean[i])
            hessian[7 + i, 7 + i] += prior.precision[i]
    if prior.shared:
        hessian[8, 8] = 1.0


@inner
def _step(data: _Data, state: LensOptimum, damping: Array, trial: LensOptimum) -> None:
    Q, x = np.zeros((2 * PARAMETERS, LANES)), vector(PARAMETERS)
    for k in range(len(damping)):
        damped_step(state.hessian[k], state.gradient[k], damping[k], Q, x)
        posterior.move_cameras(state, k, x, data.images.prior.shared, trial)
        for i in range(2):
            step = x[7 if data.prior.shared else 7 + i]
            trial.lens[k, i] = min(max(state.lens[k, i] + min(max(step, -0.1), 0.1), MIN_LENS), MAX_LENS)


@inner
def _take(state: LensOptimum, trial: LensOptimum, k: int) -> None:
    assign(state.lens[k], trial.lens[k])
    posterior.take_cameras(state, trial, k)


_minimise = minimiser(_evaluate, _step, _take, relative=False, min_damping=posterior.MIN_DAMPING)


STARTS = ((0.0, 0.0), (-0.12, -0.12), (-0.25, -0.25))  # of both lenses, where they are one
OWN_STARTS = (*STARTS, (0.0, -0.2), (-0.2, 0.0))  # where each has its own
TAIL_MEAN, TAIL_DEVIATION = -0.1, 0.15  # of an unknown lens that is not straight: most bend outwards
# A Newton step and an optimum near pinholes that make these suspicious, also in standard deviations at START_SCALE_PX,
# and an optimum that is suggested. On castle-P19 and fox these suggest a lens for 1 of 172 pairs where there is none,
# and where it is -0.1 for 81 of the 100 pairs that have 100 right matches across half of the images.
SUSPICIOUS_LENS, SUSPICIOUS_DEVIATIONS = 0.02, 0.4
SUGGESTED_LENS, SUGGESTED_DEVIATIONS, SUGGESTED_GAIN = 0.03, 3.0, 2.0
CANDIDATES = 4  # of a round, from which lenses are refined
START_SCALE_PX = 3.0  # beyond which matches do not count where the lens may be off
START_ITERATIONS, ITERATIONS = 12, 8


def fit_with_lenses(
    cameras: Cameras, lens: Array, prior: LensPrior, pair: Pair, scale_px: float, iterations: int
) -> list[LensFit]:  # fmt: skip
    """The maxima a posteriori of the truncated error near candidates, cameras (k, ...) and lenses (k, 2).
    scale_px: from which on matches do not count; of the pair as it was photographed."""
    k, images, own = len(lens), images_of(pair), cameras.copy()
    F, cost, gradient, hessian = (np.empty((k, *[PARAMETERS] * n)) for n in (1, 0, 1, 2))
    out = LensOptimum(
        *own, lens.copy(), F, cost, gradient, hessian, np.empty_like(hessian), np.empty(k), np.empty((k, 2))
    )
    prior = prior._replace(diagonal=half_diagonals(pair))
    limits = Limits(_precision(scale_px, pair), iterations, FOCAL_TOLERANCE)
    minimise_with_lenses(out, centred(pair, scale_px), images, prior, limits)
    F = np.empty((k, 9))
    translate(out.F, images.offset, F)
    F /= np.sqrt((F * F).sum(1, keepdims=True))
    numbers = cost.tolist(), out.evidence.tolist()
    each = zip(out.lens, F, numbers[0], gradient, hessian, numbers[1], out.inverse, out.deviation, strict=True)
    return [LensFit(own.of(i), *fit) for i, fit in enumerate(each)]


def squared_px(model: Array, lens: Array, pair: Pair) -> Array:
    """Squared residuals (n,) in squared pixels of the photographs, of a model (9,) and lenses (2,)."""
    images, F, r2 = images_of(pair), np.empty((1, 9)), np.empty(pair.count)
    translate(model[None], -images.offset, F)
    photograph_residuals(F[0], lens, half_diagonals(pair), centred(pair).points, r2)
    return r2 * squared(pair.pixels_per_unit)


def _noise_scale(fit: LensFit, pair: Pair) -> float:
    """From which Sampson distance on matches do not count, px, by the noise of those that lie within the start's."""
    return noise_scale(squared_px(fit.F, fit.lens, pair) / np.square(pair.noises), pair, FitScale(), START_SCALE_PX)


def lens_prior(lens: Lens) -> LensPrior:
    """The prior of the refinement: normal, of unknown lenses the tail."""
    deviation = np.clip(lens.deviations, MIN_DEVIATION, TAIL_DEVIATION)
    mean = np.where(np.isinf(lens.deviations), TAIL_MEAN, lens.means)
    return LensPrior(mean, 1 / np.square(deviation), lens.shared)


STRAIGHT = lens_prior(Lens((0.0, 0.0), (0.0, 0.0), True))
SHARED = lens_prior(Lens((0.0, 0.0), (math.inf, math.inf), True))


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
    scale = _noise_scale(min(fits, key=lambda fit: fit.cost), pair)
    best = _best(fits, prior, pair, scale)
    if unknown.all():
        none = np.zeros(2)
        pinholes = [_refined(fit._replace(lens=none), STRAIGHT, pair) for fit in fits]
        if not best.evidence > _straight_evidence(_best(pinholes, STRAIGHT, pair, scale), pair):
            return mean
    return best.lens


def _round(at: Array, prior: LensPrior, pair: Pair, search: FocalSearch) -> list[LensFit]:
    """The best of a round's candidates, of pinholes at these lenses (2,), refined with the lenses; one, or none."""
    candidates, _ = search.round(undistorted(pair, at), 0)
    best = np.argsort(-candidates.posterior, kind="stable")[:CANDIDATES]
    best = best[np.isfinite(candidates.posterior[best])]
    cameras = Cameras(candidates.cameras.axes[best], candidates.cameras.focal[best])
    fits = fit_with_lenses(cameras, np.tile(at, (len(best), 1)), prior, pair, START_SCALE_PX, START_ITERATIONS)
    return sorted((fit for fit in fits if math.isfinite(fit.cost)), key=lambda fit: fit.cost)[:1]


def _refined(
    fit: LensFit, prior: LensPrior, pair: Pair, scale_px: float = START_SCALE_PX, iterations: int = START_ITERATIONS
) -> LensFit:  # fmt: skip
    return fit_with_lenses(fit.cameras, fit.lens[None], prior, pair, scale_px, iterations)[0]


def _best(fits: list[LensFit], prior: LensPrior, pair: Pair, scale: float) -> LensFit:
    """The fit of greatest evidence at a scale near these."""
    return max((_refined(fit, prior, pair, scale, ITERATIONS) for fit in fits), key=lambda fit: fit.evidence)


def lens_fit(lens: Array, cameras: Cameras, pair: Pair, inliers: Array) -> Fit:
    """The last fit of a selected model's cameras (1, ...) and lenses (2,), at the noise of its inliers (n,)."""
    assert pair.lens is not None
    likely = inliers & (pair.match_weight > MIN_PRIOR_FOR_NOISE)
    r2 = (squared_px(_model(cameras, pair), lens, pair) / np.square(pair.noises))[likely]
    scale = fit_distance(r2, FitScale())
    (fit,) = fit_with_lenses(cameras, lens[None], lens_prior(pair.lens), pair, scale, ITERATIONS)
    counted = (squared_px(fit.F, fit.lens, pair) <= np.square(scale * pair.noises)).astype(np.float64)
    return Fit(fit.F, fit.F, counted, fit.cameras, _precision(scale, pair), lens=fit)


def _straight_evidence(fit: LensFit, pair: Pair) -> float:
    """That of pinholes, or of a fundamental matrix without plausible cameras, as of crops, if that is greater."""
    if pair.calibration is not None:
        return fit.evidence
    gain, cameras = np.empty(1), slice(LENS)
    derivatives = np.ascontiguousarray(fit.hessian[cameras, cameras]), fit.gradient[cameras]
    gain_without_prior(*derivatives, fit.cameras.focal[0], images_of(pair).prior, gain)
    return fit.evidence + max(0.0, float(gain[0]) - PRIOR_CONFLICT_GAIN)


def _precision(scale_px: float, pair: Pair) -> float:
    """One over the variance of an inlier's distance, where matches do not count from this distance on."""
    return squared(pair.pixels_per_unit / (scale_px / FitScale().scale_sigmas))


def _model(cameras: Cameras, pair: Pair) -> Array:
    F, out, images = np.empty((1, 9)), np.empty((1, 9)), images_of(pair)
    tangents_of(cameras, images.longest, F, np.zeros((1, 9, LANES)))
    translate(F, images.offset, out)
    unit: Array = out[0] / math.sqrt((out[0] * out[0]).sum())
    return unit


def suggested_lens(fit: Fit, pair: Pair) -> float:
    """One lens for both images with which the matches agree where they contradict the pinholes of a fit, or NaN.

    Where cameras agree, one Newton step of all unknowns says whether to look for it."""
    cameras, contradicted = fit.cameras, fit.cameras is None or fit.gain > DOUBTFUL_GAIN
    if cameras is None:
        cameras = posterior.no_cameras(1)
        posterior.nearest_cameras(fit.F[None], images_of(pair), cameras)
    (pinholes,) = fit_with_lenses(cameras, np.zeros((1, 2)), SHARED, pair, START_SCALE_PX, 0)

    def suspicious(lens: float, deviation: float) -> bool:
        return contradicted or abs(lens) > max(SUSPICIOUS_LENS, SUSPICIOUS_DEVIATIONS * deviation)

    step = float((pinholes.inverse[LENS] * pinholes.gradient).sum())
    if not suspicious(step, float(pinholes.deviation[0])):
        return math.nan
    near = _refined(pinholes, SHARED, pair)
    if not suspicious(float(near.lens[0]), float(near.deviation[0])):
        return math.nan
    fits = [near, *(_refined(pinholes._replace(lens=np.array(start)), SHARED, pair) for start in STARTS[1:])]
    scale = _noise_scale(min(fits, key=lambda fit: fit.cost), pair)
    best = _best(fits, SHARED, pair, scale)
    without = _straight_evidence(_best([_refined(pinholes, STRAIGHT, pair)], STRAIGHT, pair, scale), pair)
    lens, deviation = float(best.lens[0]), float(best.deviation[0])
    clear = abs(lens) > max(SUGGESTED_LENS, SUGGESTED_DEVIATIONS * deviation)
    return lens if clear and best.evidence - without > SUGGESTED_GAIN else math.nan
