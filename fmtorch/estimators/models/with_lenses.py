"""Cameras whose lenses bend straight lines: the division model, refined with the cameras, judged in the photograph.

``x_u = x_d / (1 + lambda |x_d|^2)`` (Fitzgibbon, CVPR 2001), from the principal point, in half diagonals of the image:
0 of a pinhole, -0.05 of a usual phone, -0.3 of an action camera. In homogeneous coordinates ``h = (x, y, 1 + lambda
r^2)`` the epipolar constraint is a polynomial, ``h1^T F h0 = 0``, whose Sampson distance by the photograph's own
coordinates needs no undistorted point (the tangent Sampson error of Terekhov & Larsson, ICCV 2023).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.core.types import MAX_LENS, MIN_LENS
from fmtorch.estimators.models.focal_prior import focal_cost
from fmtorch.estimators.models.posterior import (
    FIRST_DAMPING,
    MIN_DAMPING,
    Cameras,
    Images,
    Limits,
    camera_models,
    converged,
    images_of,
    move_cameras,
    take_cameras,
)
from fmtorch.estimators.pair import Pair
from fmtorch.geometry.levenberg_marquardt import MATCH, TINY, Weighted, in_rows, levenberg_marquardt, robust
from fmtorch.geometry.matrices import assign
from fmtorch.geometry.rank2_manifold import eliminate
from fmtorch.jit.kernel import Array, F8x1, F8x2, F8x3, inner, kernel, matrix, vector
from fmtorch.jit.lanes import LANES, added, fill, load, store, where

MIN_DEPTH = 0.1  # of a point beyond the corner
PARAMETERS = 9  # five rotations, two focal lengths, two lenses
ROWS = 12  # of a match: derivatives by nine entries and two lenses, and the residual


class LensPrior(NamedTuple):
    """What is known of the lenses of both images.
    mean, precision: (2,), of lambda, one over its variance. shared: whether there is one lens for both. diagonal: (2,),
    half of the images', in the unit of the points."""

    mean: F8x1
    precision: F8x1
    shared: bool
    diagonal: F8x1 = np.ones(2)


class LensOptimum(NamedTuple):
    """Of k candidates: lens (k, 2), models F (k, 9) from the principal points, costs (k,), and their derivatives."""

    lens: F8x2
    F: F8x2
    cost: F8x1
    gradient: F8x2
    hessian: F8x3


def half_diagonals(pair: Pair) -> Array:
    """Of both images (2,), in the unit of the points."""
    h0, w0, h1, w1 = pair.sizes.tolist()
    return np.array([math.sqrt(h0 * h0 + w0 * w0), math.sqrt(h1 * h1 + w1 * w1)]) / 2 / pair.pixels_per_unit


def undistorted(pair: Pair, lens: Array) -> Pair:
    """The pair of pinholes whose lenses (2,) are these; a match's noise grows as its points are stretched."""
    table = np.empty_like(pair.table)
    undistort(pair.table, images_of(pair).offset, lens, half_diagonals(pair), table)
    return Pair(
        table, (pair.known[0], True, pair.known[2]), pair.bucket, pair.pixels_per_unit, pair.key, pair.seed,
        pair.centre, pair.sizes, pair.residual, pair.calibration, pair.images,
    )  # fmt: skip


@kernel(holds_gil=True)
def undistort(table: F8x2, offset: F8x1, lens: F8x1, diagonal: F8x1, out: F8x2) -> None:
    """The rows of `Pair` (9, n) of photographs as those of pinholes -> out (9, n)."""
    for i in range(table.shape[1]):
        stretch = 0.0
        for k in range(2):
            x, y = table[2 * k, i] + offset[2 * k], table[2 * k + 1, i] + offset[2 * k + 1]
            bent = lens[k] * (x * x + y * y) / (diagonal[k] * diagonal[k])
            depth = max(1 + bent, MIN_DEPTH)
            out[2 * k, i], out[2 * k + 1, i] = x / depth - offset[2 * k], y / depth - offset[2 * k + 1]
            stretch += abs(1 - bent) / (depth * depth * depth) / 2
        out[4, i], out[5, i] = table[4, i] / stretch, table[5, i] / math.sqrt(stretch)
        out[6, i], out[7, i], out[8, i] = table[6, i], table[7, i] * math.sqrt(stretch), table[8, i]


class _State(NamedTuple):
    """Of k candidates, as `Cameras` and `LensOptimum`. tied: whether the second focal length, and the second lens, are
    the first."""

    tied: tuple[bool, bool]
    axes: Array
    focal: Array
    lens: Array
    F: Array
    cost: Array
    gradient: Array
    hessian: Array


class _Data(NamedTuple):
    """tangents: (k, 9, LANES), of the cameras; products: (ROWS, ROWS), for the work."""

    rows: Array
    loss: int
    table: Array
    images: Images
    diagonal: Array
    prior: LensPrior
    limits: Limits
    tangents: Array
    products: Array


@kernel
def minimise_with_lenses(
    cameras: Cameras, matches: Weighted, images: Images, prior: LensPrior, limits: Limits,
    out: LensOptimum,
) -> None:  # fmt: skip
    """Cameras and lenses of least negative logarithm of the posterior near these, in place; what it is there -> out.
    matches: of the photographs, from the principal points."""
    k = len(out.cost)
    tied = images.prior.shared, prior.shared
    state = _State(tied, cameras.axes, cameras.focal, out.lens, out.F, out.cost, out.gradient, out.hessian)
    trial = _State(
        tied, np.empty((k, 2, 3, 3)), matrix(k, 2), matrix(k, 2), matrix(k, 9), vector(k), matrix(k, PARAMETERS),
        np.empty((k, PARAMETERS, PARAMETERS)),
    )  # fmt: skip
    rows, products = in_rows(matches.points, matches.weight, matches.s2), matrix(ROWS, ROWS)
    data = _Data(
        rows, matches.loss, matches.table, images, prior.diagonal, prior, limits, np.zeros((k, 9, LANES)), products
    )
    _minimise(data, state, trial, np.full(k, FIRST_DAMPING), limits.iterations, limits.tolerance >= 0)


@kernel(holds_gil=True)
def photograph_residuals(F: F8x1, lens: F8x1, diagonal: F8x1, points: F8x2, out: F8x1) -> None:
    """Squared Sampson distances (n,) of points (4, n) of photographs, from the principal points, of a model (9,)."""
    n, J = points.shape[1], matrix(ROWS, LANES)
    rows, r2 = in_rows(points, np.ones(n), np.ones(n)), matrix(1, LANES)
    for first in range(0, n, LANES):
        _, value = _linearised(F, lens, diagonal, rows, first // LANES * MATCH, J)
        store(r2, 0, value)
        for i in range(min(LANES, n - first)):
            out[first + i] = r2[0, i]


@inner
def _evaluate(state: _State, data: _Data, derivatives: bool) -> None:
    camera_models(state.axes, state.focal, data.images.longest, state.tied[0], state.F, data.tangents)
    work, W = vector(5), np.zeros((ROWS - 1, PARAMETERS))
    for k in range(len(state.cost)):
        cost = _summed(state.F[k], state.lens[k], data, derivatives) * data.limits.precision / 2
        cost += focal_cost(state.focal[k], data.images.prior, work)
        for i in range(1 if data.prior.shared else 2):
            away = state.lens[k, i] - data.prior.mean[i]
            cost += data.prior.precision[i] * away * away / 2
        state.cost[k] = cost
        if derivatives:
            _derivatives(state, data, k, work, W)


@inner
def _summed(F: Array, lens: Array, data: _Data, derivatives: bool) -> Any:
    """The robust cost of one candidate; the products of derivatives and residuals -> data.products."""
    sums, work = matrix(ROWS * (ROWS + 1) // 2, LANES), matrix(3, LANES)
    J, scaled = matrix(ROWS, LANES), matrix(ROWS, LANES)
    costs = fill(0.0)
    for q in range(len(sums)):
        store(sums, q, costs)
    for row in range(0, len(data.rows), MATCH):
        inverse, r2 = _linearised(F, lens, data.diagonal, data.rows, row, J)
        share, slope = robust(r2, load(data.rows, row + 5), data.loss, data.table, work)
        costs += share * load(data.rows, row + 4)
        if derivatives:
            factor, q = inverse * (load(data.rows, row + 4) * slope), 0
            for r in range(ROWS):
                store(scaled, r, load(J, r) * factor)
            for r in range(ROWS):
                of_row = load(J, r)
                for c in range(r + 1):
                    store(sums, q, load(sums, q) + of_row * load(scaled, c))
                    q += 1
    q = 0
    for r in range(ROWS if derivatives else 0):
        for c in range(r + 1):
            total = added(load(sums, q))
            data.products[r, c], data.products[c, r] = total, total
            q += 1
    return added(costs)


@inner
def _linearised(f: Array, lens: Array, diagonal: Array, rows: Array, row: int, J: Array) -> tuple[Any, Any]:
    """Derivatives and residual of LANES matches -> J (ROWS, LANES); inverse squared slopes, squared distances."""
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
    store(J, 0, u * x0 - x1 * p)
    store(J, 1, u * y0 - x1 * q)
    store(J, 2, u * w0 - x1 * s)
    store(J, 3, v * x0 - y1 * p)
    store(J, 4, v * y0 - y1 * q)
    store(J, 5, v * w0 - y1 * s)
    store(J, 6, w * x0 - w1 * p)
    store(J, 7, w * y0 - w1 * q)
    store(J, 8, w * w0 - w1 * s)
    store(J, 9, r0 * s1 - c * (2.0 * s1 * t0 + r0 * (a1 * f[2] + b1 * f[5] + c1 * f[8])))
    store(J, 10, r1 * s0 - c * (2.0 * s0 * t1 + r1 * (a0 * f[6] + b0 * f[7] + c0 * f[8])))
    store(J, 11, e)
    r2 = e * c
    return inverse, where(r2 == r2, r2, math.nan)


@inner
def _derivatives(state: _State, data: _Data, k: int, focal: Array, W: Array) -> None:
    """Gradient and Hessian of one candidate. focal: (5,), of `focal_cost`; W: (ROWS - 1, PARAMETERS), zeros or this."""
    gradient, hessian, products, prior = state.gradient[k], state.hessian[k], data.products, data.prior
    for q in range(9):
        for i in range(7):
            W[q, i] = data.tangents[k, q, i]
    W[9, 7], W[10, 7 if prior.shared else 8] = 1 / data.diagonal[0] ** 2, 1 / data.diagonal[1] ** 2
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
def _step(state: _State, damping: Array, trial: _State) -> None:
    Q, x = np.zeros((2 * PARAMETERS, LANES)), vector(PARAMETERS)
    for k in range(len(damping)):
        for r in range(PARAMETERS):  # two rows of Q for each of the system
            for c in range(PARAMETERS):
                Q[2 * r + c // LANES, c % LANES] = state.hessian[k, r, c]
            Q[2 * r + r // LANES, r % LANES] += state.hessian[k, r, r] * damping[k]
            Q[2 * r + 1, PARAMETERS - LANES] = -state.gradient[k, r]
        eliminate(Q, PARAMETERS)
        for r in range(PARAMETERS):
            x[r] = Q[2 * r + 1, PARAMETERS - LANES]
        move_cameras(state, k, x, state.tied[0], trial)
        for i in range(2):
            step = x[7 if state.tied[1] else 7 + i]
            trial.lens[k, i] = min(max(state.lens[k, i] + min(max(step, -0.1), 0.1), MIN_LENS), MAX_LENS)


@inner
def _take(state: _State, trial: _State, k: int) -> None:
    assign(state.lens[k], trial.lens[k])
    take_cameras(state, trial, k)


_minimise = levenberg_marquardt(_evaluate, _step, _take, converged, MIN_DAMPING)
