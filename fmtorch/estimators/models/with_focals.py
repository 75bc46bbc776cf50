"""Fundamental matrices of cameras with plausible focal lengths: samples of five matches and drawn focal lengths."""

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fmtorch.estimators.models import posterior
from fmtorch.estimators.models.focal_prior import FocalPrior, draw_depths, focal_cost
from fmtorch.estimators.models.fundamental import Hypotheses
from fmtorch.estimators.models.posterior import Cameras, Images, Limits, Optimum, centred, images_of
from fmtorch.estimators.pair import Pair, squared
from fmtorch.geometry.arithmetic import exponential
from fmtorch.geometry.epipolar import TINY_OF_KERNEL, sampson_parts
from fmtorch.geometry.five_point import five_point
from fmtorch.geometry.levenberg_marquardt import GEMAN_MCCLURE, MATCH, Weighted, in_rows
from fmtorch.geometry.matrices import unit_kernel
from fmtorch.geometry.pose import handedness
from fmtorch.geometry.rank2_manifold import damped_step
from fmtorch.geometry.refine import STEP_DAMPING
from fmtorch.jit.kernel import Array, F8x1, F8x2, inner, kernel, matrix, vector
from fmtorch.jit.lanes import LANES, absolute, added, fill, load, sqrt, where
from fmtorch.jit.random import Stream

SOLUTIONS = 10  # of five matches, at most
INLIER_SIGMA_PX = 0.3  # standard deviation of an inlier's Sampson distance
LOSS_SCALE_PX = 0.7  # Sampson distance at which an inlier's cost is half of what a squared one would be
PARALLEL_PX = 4.0  # in image 1: rays that differ less do not tell on which side of the cameras they meet


class Refined(NamedTuple):
    """Of k candidates, models (k, 9), costs of the prior (k,), shares of the support in front of both cameras (k,)."""

    models: F8x2
    cost: F8x1
    share: F8x1


class FundamentalWithFocals:
    """Square pixels, central principal points, usual focal lengths, of images whose sizes are known."""

    size: ClassVar[int] = 5

    def solve(self, pair: Pair, sample: Array, start: int) -> Hypotheses:
        """As `Matrices.solve`, with focal lengths drawn from their prior."""
        count, images = sample.shape[1], images_of(pair)
        depth, F = np.empty((2, count)), np.empty((SOLUTIONS * count, 9), np.float32)
        draw = np.empty(len(F), np.int64)
        draw_depths(images.prior, images.longest, pair.mixed_seed(Stream.FOCAL), pair.key, start, depth)
        models = five_point(centred(pair).points, sample, depth, images.offset, F, draw)
        return Hypotheses(F[:models], draw[:models], sample, start)

    def refine(self, F: Array, pair: Pair, iterations: int) -> tuple[Cameras, Refined]:
        """Models of least ``sum P rho(r) / (2 sigma^2) + cost(f0, f1)`` near F (k, 9), and their cameras.

        r is the Sampson distance in pixels, sigma INLIER_SIGMA_PX, rho the loss of Geman & McClure at LOSS_SCALE_PX.
        A model that is not finite comes back as something that is not, with a prior cost of infinity."""
        k, precision = len(F), squared(pair.pixels_per_unit / INLIER_SIGMA_PX)
        cameras, refined = posterior.no_cameras(k), Refined(np.empty((k, 9)), np.empty(k), np.empty(k))
        limits, parallel = Limits(precision, iterations, -1.0), PARALLEL_PX / pair.pixels_per_unit
        refine_with_prior(F, Subset(pair.table, images_of(pair), parallel, LOSS_SCALE_PX), limits, cameras, refined)
        return cameras, refined

    def fit(self, start: Cameras, pair: Pair, truncation: float, limits: Limits) -> tuple[Array, Cameras, float]:
        """The maximum a posteriori of the truncated Sampson error near one candidate: a model (9,), its cameras, and
        what the logarithm of the likelihood would gain without prior. truncation: px."""
        cameras, images = start.copy(), images_of(pair)
        out, F, gain = posterior.start_at(cameras), np.empty((1, 9)), np.empty(1)
        posterior.minimise(out, centred(pair, truncation), images, limits)
        posterior.translate(out.F, images.offset, F)
        gain_without_prior(out.hessian[0], out.gradient[0], cameras.focal[0], images.prior, gain)
        return F[0], cameras, float(gain[0])


class Subset(NamedTuple):
    """Matches by which candidates are refined. table: of `Pair`. parallel: of `cheirality`. scale: of the loss, px."""

    table: F8x2
    images: Images
    parallel: float
    scale: float


@kernel
def refine_with_prior(F: F8x2, subset: Subset, limits: Limits, cameras: Cameras, out: Refined) -> None:
    """`FundamentalWithFocals.refine` of models (k, 9) -> cameras, out."""
    table, images, k = subset.table, subset.images, len(F)
    axes, focal = cameras.axes, cameras.focal
    optimum = Optimum(axes, focal, matrix(k, 9), vector(k), matrix(k, 7), np.empty((k, 7, 7)))
    centred_matches = matrix(6, table.shape[1])
    posterior.centre(table, images.offset, subset.scale, centred_matches)
    points, s2, scale = centred_matches[:4], centred_matches[4], centred_matches[5]
    posterior.nearest_cameras(F, images, cameras)
    posterior.minimise(optimum, Weighted(points, table[4], s2, GEMAN_MCCLURE, matrix(2, 0)), images, limits)
    posterior.translate(optimum.F, images.offset, out.models)
    work = vector(5)
    for i in range(k):
        unit_kernel(out.models[i])
        out.cost[i] = focal_cost(cameras.focal[i], images.prior, work)
        finite = math.isfinite(optimum.cost[i])
        for q in range(9):
            finite = finite and math.isfinite(out.models[i, q])
        if not finite:
            out.cost[i] = math.inf
    support = Weighted(points, table[6], scale, GEMAN_MCCLURE, matrix(2, 0))
    cheirality(cameras, images.longest, optimum.F, support, subset.parallel, out.share)


@kernel(holds_gil=True)
def gain_without_prior(hessian: F8x2, gradient: F8x1, focal: F8x1, prior: FocalPrior, out: F8x1) -> None:
    """What the logarithm of the likelihood would rise by at an optimum without prior -> out (1,)."""
    Q, H, g, x, work, total = matrix(7, LANES), matrix(7, 7), vector(7), vector(7), vector(5), 0.0
    focal_cost(focal, prior, work)
    for i in range(7):
        g[i] = gradient[i] - (work[i - 5] if i >= 5 else 0.0)
        for j in range(7):
            own = 0.0
            if i >= 5 and j >= 5:
                own = work[i - 3] if i == j else work[4]
            H[i, j] = hessian[i, j] - own
    damped_step(H, g, STEP_DAMPING, Q, x)
    for i in range(7):
        total += g[i] * x[i]
    out[0] = -total / 2


# On which side of both cameras matches lie: of the candidates of one pair

BITS = 20  # fractional, of the support, so that its sums are exact
REST = 1 / 26  # of the gain of Geman & McClure at 5 scales, from which on it is zero


@kernel(holds_gil=True)
def cheirality(cameras: Cameras, longest: F8x1, F: F8x2, matches: Weighted, tolerance: float, out: F8x1) -> None:
    """The share of the support that lies in front of both cameras, for the better of their poses -> out (k,).
    Support is each match's weight times the gain of Geman & McClure; matches of rays that are parallel up to the
    tolerance, in the unit of the points, lie on either side. longest: (2,), the longer sides of the images. F: (k, 9),
    the cameras' models. matches: from the principal points; their s2 is *one over* the square of each one's scale."""
    axes, focal = cameras.axes, cameras.focal
    rows, shift = in_rows(matches.points, matches.weight, matches.s2), 1.5 * 2.0 ** (52 - BITS)
    for k in range(len(out)):
        U, V, f = axes[k, 0], axes[k, 1], F[k]
        handed = handedness(U) * handedness(V)
        d0, d1 = exponential(focal[k, 0]) * longest[0], exponential(focal[k, 1]) * longest[1]
        total, front = fill(0.0), fill(0.0)
        back, mirrored, both = front, front, front
        for row in range(0, len(rows), MATCH):
            x0, y0, x1, y1 = load(rows, row), load(rows, row + 1), load(rows, row + 2), load(rows, row + 3)
            support = _gain(f, x0, y0, x1, y1, load(rows, row + 5)) * load(rows, row + 4) + shift - shift
            total += support
            a1, b1 = _ray(V, 0, x0, y0, d0), _ray(U, 0, x1, y1, d1)
            a2, b2 = _ray(V, 1, x0, y0, d0), _ray(U, 1, x1, y1, d1)
            a3, b3 = _ray(V, 2, x0, y0, d0), _ray(U, 2, x1, y1, d1)
            a, b, side = a1 * a1 + a2 * a2, b1 * b1 + b2 * b2, a1 * b2 - a2 * b1
            distance = b3 * absolute(side) - handed * a3 * b
            parallel = sqrt(b * (b + b3 * b3) * (a + a3 * a3)) * (tolerance / d1)
            ahead, behind = distance > -parallel, -distance > -parallel
            front += where(ahead & (side > 0.0), support, 0.0)
            back += where(behind & (side > 0.0), support, 0.0)
            mirrored += where(ahead & (side < 0.0), support, 0.0)
            both += where(behind & (side < 0.0), support, 0.0)
        largest, total_support = max(max(added(front), added(back)), max(added(mirrored), added(both))), added(total)
        out[k] = largest / total_support if total_support > 0 else math.nan


@inner
def _gain(f: Array, x0: Any, y0: Any, x1: Any, y1: Any, scale: Any) -> Any:
    e, slope = sampson_parts(f, x0, y0, x1, y1)
    gain = 1.0 / (1.0 + e * e / where(slope > TINY_OF_KERNEL, slope, TINY_OF_KERNEL) * scale) - REST
    return where(gain > 0.0, gain, 0.0) * (1 / (1 - REST))


@inner
def _ray(M: Array, axis: int, x: Any, y: Any, depth: float) -> Any:
    """A component of points' rays in the axes of a camera."""
    return M[2, axis] + M[0, axis] / depth * x + M[1, axis] / depth * y
