"""The posterior of two cameras given matches, and its maximum near models: refinement with the prior.

axes: (k, 2, 3, 3), U and V of ``E = U diag(1, 1, 0) V^T``, rows first. focal: (k, 2), logarithms of focal lengths in
units of the longer sides. Points are from the principal points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, F8x1, F8x2, F8x3
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.lanes import LANES, fill, load, store
from fmtorch.compiling.scratch import matrix, vector
from fmtorch.estimators.families.cameras import Cameras, Images
from fmtorch.estimators.families.focal_prior import focal_cost
from fmtorch.geometry.arithmetic_kernels import exponential
from fmtorch.geometry.levenberg_marquardt_kernels import levenberg_marquardt
from fmtorch.geometry.rank2_kernels import assign, assign_rows
from fmtorch.geometry.rank2_manifold_kernels import eliminate
from fmtorch.geometry.sampson_objective_kernels import Weighted, evaluate

FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-9, 1e6


class Limits(NamedTuple):
    """precision: one over the variance of an inlier's distance. iterations: steps at most. tolerance: what a step must
    lower the cost of a candidate by, if its fit is to go on; negative: none is ever done, and the derivatives are not
    those at the end."""

    precision: float
    iterations: int
    tolerance: float


class Optimum(NamedTuple):
    """Of k candidates, models F (k, 9), costs (k,), and their derivatives by five rotations and two logarithms,
    gradient (k, 7), hessian (k, 7, 7)."""

    F: F8x2
    cost: F8x1
    gradient: F8x2
    hessian: F8x3


class _State(NamedTuple):
    """Of k candidates, cameras, models (k, 9), costs (k,), and their derivatives (k, 7), (k, 7, 7).

    shared: whether the two focal lengths are one; the sixth parameter is then its logarithm and the seventh has none.
    """

    axes: Array
    focal: Array
    F: Array
    cost: Array
    gradient: Array
    hessian: Array
    shared: bool


class _Data(NamedTuple):
    """What `minimise` is given; tangents (k, 9, LANES), of which 7 count, and products (k, 10, 10) for the work."""

    matches: Weighted
    images: Images
    limits: Limits
    tangents: Array
    products: Array


def no_optimum(k: int) -> Optimum:
    """Room for the optima of k candidates."""
    return Optimum(np.empty((k, 9)), np.empty(k), np.empty((k, 7)), np.empty((k, 7, 7)))


@kernel
def minimise(cameras: Cameras, matches: Weighted, images: Images, limits: Limits, out: Optimum) -> None:
    """Cameras of least negative logarithm of the posterior near these, in place; what it is there -> out."""
    k, shared = len(out.cost), images.prior.shared
    state = _State(cameras.axes, cameras.focal, out.F, out.cost, out.gradient, out.hessian, shared)
    axes, hessian = np.empty((k, 2, 3, 3)), np.empty((k, 7, 7))
    trial = _State(axes, matrix(k, 2), matrix(k, 9), vector(k), matrix(k, 7), hessian, shared)
    data = _Data(matches, images, limits, np.zeros((k, 9, LANES)), np.empty((k, 10, 10)))
    _minimise(data, state, trial, np.full(k, FIRST_DAMPING), limits.iterations, limits.tolerance >= 0)


@kernel(holds_gil=True)
def tangents_of(cameras: Cameras, longest: F8x1, F: F8x2, out: F8x3) -> None:
    """Fundamental matrices -> F (k, 9), and their derivatives by five rotations and two logarithms -> (k, 9, LANES)."""
    _models(cameras.axes, cameras.focal, longest, F, out)


@inner
def _evaluate(state: _State, data: _Data, derivatives: bool) -> None:
    _models(state.axes, state.focal, data.images.longest, state.F, data.tangents)
    if state.shared:
        _tie(data.tangents)
    evaluate(state.F, data.matches, derivatives, data.products, state.cost)
    work = vector(5)
    for k in range(len(state.cost)):
        prior = focal_cost(state.focal[k], data.images.prior, work)
        state.cost[k] = state.cost[k] * data.limits.precision / 2 + prior
        if derivatives:
            _derivatives(
                data.products[k], data.tangents[k], work, data.limits.precision, state.gradient[k], state.hessian[k]
            )


@inner
def _models(axes: Array, focal: Array, longest: Array, F: Array, tangents: Array) -> None:
    """Fundamental matrices -> F (k, 9), and their derivatives by five rotations and two logarithms -> (k, 9, LANES)."""
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


@inner
def _tie(tangents: Array) -> None:
    """One logarithm for both images: derivatives (k, 9, LANES) by the first are those by it, by the second zero."""
    for k in range(len(tangents)):
        for q in range(9):
            tangents[k, q, 5] += tangents[k, q, 6]
            tangents[k, q, 6] = 0.0


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
def _step(state: _State, damping: Array, trial: _State) -> None:
    Q = matrix(7, LANES)
    for k in range(len(damping)):
        damped_step(state.hessian[k], state.gradient[k], damping[k], Q)
        _rotate(state.axes[k, 0], Q[0, 7] / 2, Q[1, 7] / 2, Q[2, 7] / 2, trial.axes[k, 0])
        _rotate(state.axes[k, 1], Q[3, 7] / 2, Q[4, 7] / 2, 0.0, trial.axes[k, 1])
        for i in range(2):
            step = Q[5 if state.shared else 5 + i, 7]
            trial.focal[k, i] = min(max(state.focal[k, i] + min(max(step, -1.0), 1.0), -3.0), 3.0)


@inner
def damped_step(hessian: Array, gradient: Array, damping: float, Q: Array) -> None:
    """Solves ``(H + damping diag H) x = -gradient`` -> last column of Q (7, LANES)."""
    for i in range(7):
        for j in range(7):
            Q[i, j] = hessian[i, j]
        Q[i, i] += hessian[i, i] * damping
        Q[i, 7] = -gradient[i]
    eliminate(Q, 7)


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
def _accept(state: _State, trial: _State, damping: Array, done: Array, data: _Data) -> bool:
    everything = True
    for k in range(len(damping)):
        better = trial.cost[k] < state.cost[k] and not done[k]
        damping[k] = min(max(damping[k] / 10 if better else damping[k] * 10, MIN_DAMPING), MAX_DAMPING)
        if better:
            done[k] |= data.limits.tolerance >= 0 and state.cost[k] - trial.cost[k] <= data.limits.tolerance
            state.cost[k] = trial.cost[k]
            assign(state.focal[k], trial.focal[k])
            assign(state.F[k], trial.F[k])
            assign(state.gradient[k], trial.gradient[k])
            assign_rows(state.axes[k, 0], trial.axes[k, 0])
            assign_rows(state.axes[k, 1], trial.axes[k, 1])
            assign_rows(state.hessian[k], trial.hessian[k])
        everything = everything and done[k]
    return everything


_minimise = levenberg_marquardt(_evaluate, _step, _accept)
