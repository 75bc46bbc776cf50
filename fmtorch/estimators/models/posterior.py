"""The posterior of two cameras given matches, and its maximum near models: refinement with the prior.

axes: (k, 2, 3, 3), U and V of ``E = U diag(1, 1, 0) V^T``, rows first. focal: (k, 2), logarithms of focal lengths in
units of the longer sides. Points are from the principal points."""

import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.estimators.models.focal_prior import LOG_USUAL, FocalPrior, focal_cost, focal_prior
from fmtorch.estimators.pair import EXACT, Pair
from fmtorch.geometry.arithmetic import exponential, logarithm_kernel
from fmtorch.geometry.levenberg_marquardt import SQUARINGS, Weighted, evaluate, minimiser
from fmtorch.geometry.matrices import assign, assign_rows
from fmtorch.geometry.pose import nearest_axes
from fmtorch.geometry.rank2_manifold import damped_step, start_one
from fmtorch.jit.kernel import Array, F8x1, F8x2, F8x3, F8x4, inner, kernel, matrix, vector
from fmtorch.jit.lanes import LANES, fill, load, store

MIN_IMAGE_SIDE_PX = 16.0  # longer side of both images below which sizes are taken for those of another unit than pixels
MIN_FOCAL, MAX_FOCAL = 0.25, 5.0  # focal lengths outside, in units of the longer side, are not believed at the start


class Cameras(NamedTuple):
    """The cameras of k candidates: axes (k, 2, 3, 3), U and V, rows first; focal (k, 2), logarithms."""

    axes: F8x4
    focal: F8x2

    def of(self, k: int) -> "Cameras":
        """Those of one candidate."""
        return Cameras(self.axes[k : k + 1], self.focal[k : k + 1])

    def joined(self, other: "Cameras") -> "Cameras":
        """The candidates of both."""
        return Cameras(np.concatenate([self.axes, other.axes]), np.concatenate([self.focal, other.focal]))

    def copy(self) -> "Cameras":
        """The same in memory of its own."""
        return Cameras(self.axes.copy(), self.focal.copy())


def no_cameras(k: int) -> Cameras:
    """Room for the cameras of k candidates."""
    return Cameras(np.empty((k, 2, 3, 3)), np.empty((k, 2)))


class Images(NamedTuple):
    """Two images in normalised units. offset: (4,), from the points to those from the principal points. longest: (2,),
    the longer sides. prior: on the focal lengths."""

    offset: F8x1
    longest: F8x1
    prior: FocalPrior


def images_of(pair: Pair) -> Images:
    """The images of a pair whose sizes are known, computed once."""
    images: Images | None = pair.images.get("images")
    if images is not None:
        return images
    unit, (h0, w0, h1, w1) = pair.pixels_per_unit, pair.sizes.tolist()
    sides = w0, h0, w1, h1
    # Half a pixel, of images in pixels; of sizes in another unit nobody knows what it is, and it is small.
    pixel = 0.0 if max(sides) < MIN_IMAGE_SIDE_PX else 1.0
    offset = np.array([(x - (side - pixel) / 2) / unit for x, side in zip(pair.centre.tolist(), sides, strict=True)])
    prior = focal_prior(pair.same_size)
    if (known := pair.calibration) is not None:
        measured = known.logarithms((max(h0, w0), max(h1, w1)))
        prior = focal_prior(pair.same_size, known.shared, measured, known.deviations)
    images = Images(offset, np.array([max(h0, w0) / unit, max(h1, w1) / unit]), prior)
    pair.images["images"] = images
    return images


def focals_px(cameras: Cameras, pair: Pair) -> Array:
    """The focal lengths (2,) of the first candidate, px."""
    f0, f1 = cameras.focal[0].tolist()
    return np.array([exponential(f0), exponential(f1)]) * images_of(pair).longest * pair.pixels_per_unit


def focals_near(F: Array, pair: Pair) -> Array:
    """The focal lengths (2,) near a model (9,), px, by Bougnoux's formula; NaN of those that are measured."""
    cameras, calibration = no_cameras(1), pair.calibration
    nearest_cameras(F[None], images_of(pair), cameras)
    focals = focals_px(cameras, pair)
    return focals if calibration is None else np.where(np.isinf(calibration.deviations), focals, np.nan)


def focal_precision(focals: Array, pair: Pair) -> Array:
    """The second derivatives (2, 2) of the prior's cost by the logarithms of the focal lengths (2,), px.
    Infinite on the diagonal where a focal length is exactly known; one parameter that both share has the first place.
    """
    images, work = images_of(pair), np.empty(5)
    if pair.calibration is not None:
        focals = np.where(np.isnan(focals), pair.calibration.focals, focals)
    f0, f1 = (focals / (images.longest * pair.pixels_per_unit)).tolist()
    focal_cost(np.array([logarithm_kernel(f0), logarithm_kernel(f1)]), images.prior, work)
    precision = np.array([[work[2], work[4]], [work[4], 0.0 if images.prior.shared else work[3]]])
    if pair.calibration is not None:
        exact = np.array(pair.calibration.deviations) < EXACT
        np.fill_diagonal(precision, np.where(exact, np.inf, precision.diagonal()))
    return precision


def parallax(cameras: Cameras, pair: Pair) -> Array:
    """How far points of image 1 are from where points at infinity would be, in the unit of the points: by either of the
    rotations of an essential matrix, the cameras of one candidate, (2, n)."""
    out, depth = np.empty((2, pair.count)), focals_px(cameras, pair) / pair.pixels_per_unit
    beside_rotations(cameras.axes[0], depth, images_of(pair).offset, pair.points, out)
    return out


def centred(pair: Pair, scale_px: float = 1.0) -> Weighted:
    """The matches of a pair whose image sizes are known, from the principal points, computed once.
    scale_px: from which on they do not count."""

    def compute(pair: Pair) -> Weighted:
        out = np.empty((6, pair.count))
        centre(pair.table, images_of(pair).offset, scale_px, out)
        return Weighted.of(out[:4], pair.weight, out[4])

    return pair.cached(("centred", scale_px), compute)


@kernel(holds_gil=True)
def beside_rotations(axes: F8x3, depth: F8x1, offset: F8x1, points: F8x2, out: F8x2) -> None:
    """How far points (4, n) are from where the two rotations (2, n) turn them, by depths (2,) -> out."""
    U, V = axes[0], axes[1]
    for i in range(points.shape[1]):
        x, y = (points[0, i] + offset[0]) / depth[0], (points[1, i] + offset[1]) / depth[0]
        a = V[0, 0] * x + V[1, 0] * y + V[2, 0]
        b = V[0, 1] * x + V[1, 1] * y + V[2, 1]
        c = V[0, 2] * x + V[1, 2] * y + V[2, 2]
        for turn in range(2):
            s = 1.0 - 2.0 * turn
            z = s * (a * U[2, 1] - b * U[2, 0]) + c * U[2, 2]
            dx = (s * (a * U[0, 1] - b * U[0, 0]) + c * U[0, 2]) / z * depth[1] - points[2, i] - offset[2]
            dy = (s * (a * U[1, 1] - b * U[1, 0]) + c * U[1, 2]) / z * depth[1] - points[3, i] - offset[3]
            out[turn, i] = math.sqrt(dx * dx + dy * dy)


@kernel(holds_gil=True)
def translate(F: F8x2, offset: F8x1, out: F8x2) -> None:
    """Models (k, 9) for points from which the offset (4,) is taken -> out (k, 9)."""
    for k in range(len(F)):
        for r in range(3):
            a, b = F[k, 3 * r], F[k, 3 * r + 1]
            out[k, 3 * r], out[k, 3 * r + 1] = a, b
            out[k, 3 * r + 2] = F[k, 3 * r + 2] + offset[0] * a + offset[1] * b
        for c in range(3):
            out[k, 6 + c] += offset[2] * out[k, c] + offset[3] * out[k, 3 + c]


@kernel(holds_gil=True)
def centre(table: F8x2, offset: F8x1, scale_px: float, out: F8x2) -> None:
    """Points from the principal points, squared scales of a loss, and one over these -> out (6, n).
    table: (9, n), of `Pair`. offset: (4,), what is added to points. scale_px: of the loss, of a usual match."""
    for i in range(table.shape[1]):
        for r in range(4):
            out[r, i] = table[r, i] + offset[r]
        scale = table[5, i]
        out[4, i], out[5, i] = (scale_px / scale) * (scale_px / scale), (scale / scale_px) * (scale / scale_px)


@kernel(holds_gil=True)
def nearest_cameras(F: F8x2, images: Images, cameras: Cameras) -> None:
    """Cameras near models (k, 9): those of their focal lengths, or of usual or measured ones where these are
    implausible; of exactly measured ones."""
    axes, focal, longest, shifted = cameras.axes, cameras.focal, images.longest, np.empty(F.shape)
    prior = images.prior
    measured = prior.precision[0] > 0 or prior.precision[1] > 0
    translate(F, -images.offset, shifted)
    G, M, e0, e1 = vector(9), vector(9), vector(3), vector(3)
    for k in range(len(shifted)):
        start_one(shifted[k], SQUARINGS, G, e0, e1)
        first = _squared_focal(G, 1, 3, e1) / (longest[0] * longest[0])
        second = _squared_focal(G, 3, 1, e0) / (longest[1] * longest[1])
        plausible0, plausible1 = MIN_FOCAL**2 < first < MAX_FOCAL**2, MIN_FOCAL**2 < second < MAX_FOCAL**2
        if not measured:  # one implausible focal length speaks against the other
            plausible0 = plausible0 and plausible1
            plausible1 = plausible0
        focal[k, 0] = logarithm_kernel(first) / 2 if plausible0 else LOG_USUAL
        focal[k, 1] = logarithm_kernel(second) / 2 if plausible1 else LOG_USUAL
        for i in range(2):
            plausible = plausible0 if i == 0 else plausible1
            if prior.precision[i] > 1 / EXACT**2 or (prior.precision[i] > 0 and not plausible):
                focal[k, i] = prior.measured[i]
        if prior.shared:
            focal[k, 0] = (focal[k, 0] + focal[k, 1]) / 2
            focal[k, 1] = focal[k, 0]
        d0 = 1 / (exponential(focal[k, 0]) * longest[0])
        d1 = 1 / (exponential(focal[k, 1]) * longest[1])
        for r in range(3):
            G[3 * r + 2] *= d0
        for c in range(3):
            G[6 + c] *= d1
        start_one(G, 0, M, e0, e1)
        nearest_axes(M, e0, e1, axes[k, 0], axes[k, 1])


@inner
def _squared_focal(F: Array, column: int, row: int, e: Array) -> Any:
    """Bougnoux's formula (ICCV 1998) for the camera whose points F's columns belong to; steps exchanged, the other."""
    r0 = -F[0] * e[1] + F[row] * e[0]
    r1 = -F[column] * e[1] + F[row + column] * e[0]
    r2 = -F[2 * column] * e[1] + F[row + 2 * column] * e[0]
    return -(r2 * F[8]) / (r0 * F[2 * row] + r1 * F[2 * row + column])


FIRST_DAMPING, MIN_DAMPING = 1e-3, 1e-9


class Limits(NamedTuple):
    """precision: one over the variance of an inlier's distance. iterations: steps at most. tolerance: what a step must
    lower the cost of a candidate by, if its fit is to go on; negative: none is ever done, and the derivatives are not
    those at the end."""

    precision: float
    iterations: int
    tolerance: float


class Optimum(NamedTuple):
    """Of k candidates, cameras, models F (k, 9), costs (k,), and derivatives by five rotations and two logarithms,
    gradient (k, 7), hessian (k, 7, 7). Of one focal length for both the sixth is its logarithm and the seventh none."""

    axes: F8x4
    focal: F8x2
    F: F8x2
    cost: F8x1
    gradient: F8x2
    hessian: F8x3


class _Data(NamedTuple):
    """What `minimise` is given; tangents (k, 9, LANES), of which 7 count, and products (k, 10, 10) for the work."""

    matches: Weighted
    images: Images
    limits: Limits
    tangents: Array
    products: Array


def start_at(cameras: Cameras) -> Optimum:
    """Room for the optima near cameras, which they take the place of."""
    k = len(cameras.focal)
    return Optimum(*cameras, np.empty((k, 9)), np.empty(k), np.empty((k, 7)), np.empty((k, 7, 7)))


@kernel
def minimise(state: Optimum, matches: Weighted, images: Images, limits: Limits) -> None:
    """Cameras of least negative logarithm of the posterior near these, and what it is there, in place."""
    k = len(state.cost)
    axes, hessian = np.empty((k, 2, 3, 3)), np.empty((k, 7, 7))
    trial = Optimum(axes, matrix(k, 2), matrix(k, 9), vector(k), matrix(k, 7), hessian)
    data = _Data(matches, images, limits, np.zeros((k, 9, LANES)), np.empty((k, 10, 10)))
    _minimise(data, state, trial, np.full(k, FIRST_DAMPING), limits.iterations, limits.tolerance)


@kernel(holds_gil=True)
def tangents_of(cameras: Cameras, longest: F8x1, F: F8x2, out: F8x3) -> None:
    """Fundamental matrices -> F (k, 9), and their derivatives by five rotations and two logarithms -> (k, 9, LANES)."""
    camera_models(cameras.axes, cameras.focal, longest, False, F, out)


@inner
def _evaluate(state: Optimum, data: _Data, derivatives: bool) -> None:
    images = data.images
    camera_models(state.axes, state.focal, images.longest, images.prior.shared, state.F, data.tangents)
    evaluate(state.F, data.matches, derivatives, data.products, state.cost)
    work = vector(5)
    for k in range(len(state.cost)):
        prior = focal_cost(state.focal[k], images.prior, work)
        state.cost[k] = state.cost[k] * data.limits.precision / 2 + prior
        if derivatives:
            _derivatives(
                data.products[k], data.tangents[k], work, data.limits.precision, state.gradient[k], state.hessian[k]
            )


@inner
def camera_models(axes: Array, focal: Array, longest: Array, shared: bool, F: Array, tangents: Array) -> None:
    """Fundamental matrices -> F (k, 9), and their derivatives by five rotations and two logarithms -> (k, 9, LANES).
    shared: one logarithm for both images; the derivatives by the first are those by it, by the second zero."""
    for k in range(len(F)):
        U, V, T = axes[k, 0], axes[k, 1], tangents[k]
        d0, d1 = exponential(focal[k, 0]) * longest[0], exponential(focal[k, 1]) * longest[1]
        for r in range(3):
            for c in range(3):
                by, q = (d0 if c == 2 else 1.0) * (d1 if r == 2 else 1.0), 3 * r + c
                F[k, q] = (U[r, 0] * V[c, 0] + U[r, 1] * V[c, 1]) * by
                T[q, 0], T[q, 1] = U[r, 2] * V[c, 1] * by, -U[r, 2] * V[c, 0] * by
                T[q, 2] = (U[r, 1] * V[c, 0] - U[r, 0] * V[c, 1]) * by
                T[q, 3], T[q, 4] = U[r, 1] * V[c, 2] * by, -U[r, 0] * V[c, 2] * by
                T[q, 5], T[q, 6] = F[k, q] if c == 2 else 0.0, F[k, q] if r == 2 else 0.0
        for q in range(9 if shared else 0):
            T[q, 5], T[q, 6] = T[q, 5] + T[q, 6], 0.0


@inner
def _derivatives(
    products: Array, tangents: Array, prior: Array, precision: float, gradient: Array, hessian: Array
) -> None:  # fmt: skip
    """Of one candidate. products: (10, 10), of `evaluate`; tangents: (9, LANES); prior: (5,), of `focal_cost`."""
    along, column = matrix(10, LANES), matrix(1, LANES)
    for j in range(10):
        total = fill(0.0)
        for q in range(9):
            total += load(tangents, q) * products[q, j]
        store(along, j, total)
    for i in range(7):
        gradient[i] = along[9, i] * precision
    for j in range(7):
        total = fill(0.0)
        for q in range(9):
            total += load(tangents, q) * along[q, j]
        store(column, 0, total * precision)
        for i in range(7):
            hessian[i, j] = column[0, i]
    for i in range(2):
        gradient[5 + i] += prior[i]
        for j in range(2):
            hessian[5 + i, 5 + j] += prior[2 + i] if i == j else prior[4]


@inner
def _step(data: _Data, state: Optimum, damping: Array, trial: Optimum) -> None:
    Q, x = matrix(7, LANES), vector(7)
    for k in range(len(damping)):
        damped_step(state.hessian[k], state.gradient[k], damping[k], Q, x)
        move_cameras(state, k, x, data.images.prior.shared, trial)


@inner
def move_cameras(state: Any, k: int, x: Array, shared: bool, trial: Any) -> None:
    """The cameras of candidate k after a step x of five rotations and two logarithms, which is bounded -> trial."""
    _rotate(state.axes[k, 0], x[0] / 2, x[1] / 2, x[2] / 2, trial.axes[k, 0])
    _rotate(state.axes[k, 1], x[3] / 2, x[4] / 2, 0.0, trial.axes[k, 1])
    for i in range(2):
        step = x[5 if shared else 5 + i]
        trial.focal[k, i] = min(max(state.focal[k, i] + min(max(step, -1.0), 1.0), -3.0), 3.0)


@inner
def _rotate(A: Array, x: float, y: float, z: float, out: Array) -> None:
    """``A R`` with the Cayley rotation of (x, y, z), half of its angles -> out (3, 3)."""
    n = x * x + y * y + z * z
    factor = 2 / (1 + n)
    for r in range(3):
        a, b, c = A[r, 0], A[r, 1], A[r, 2]
        along = a * x + b * y + c * z
        out[r, 0] = a + factor * (z * b - y * c + along * x - n * a)
        out[r, 1] = b + factor * (x * c - z * a + along * y - n * b)
        out[r, 2] = c + factor * (y * a - x * b + along * z - n * c)


@inner
def take_cameras(state: Any, trial: Any, k: int) -> None:
    """Candidate k of a trial -> state, but for its cost."""
    assign(state.focal[k], trial.focal[k])
    assign(state.F[k], trial.F[k])
    assign(state.gradient[k], trial.gradient[k])
    assign_rows(state.axes[k, 0], trial.axes[k, 0])
    assign_rows(state.axes[k, 1], trial.axes[k, 1])
    assign_rows(state.hessian[k], trial.hessian[k])


_minimise = minimiser(_evaluate, _step, take_cameras, relative=False, min_damping=MIN_DAMPING)
