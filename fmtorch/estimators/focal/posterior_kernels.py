"""`posterior.Posterior` for the candidates of one pair, compiled: models of two cameras, their posterior, its steps.

axes: (k, 2, 3, 3), U and V of ``E = U diag(1, 1, 0) V^T``, rows first. focal: (k, 2), logarithms of focal lengths in
units of the longer sides. longest: (2,), these sides in the unit of the points, which are from the principal points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.estimators.focal.prior_kernels import focal_cost
from fmtorch.geometry.arithmetic_kernels import exponential
from fmtorch.geometry.rank2_kernels import assign, assign_rows, unit
from fmtorch.geometry.rank2_manifold_kernels import eliminate
from fmtorch.kernels import inner, kernel

Array = NDArray[Any]
MIN_DAMPING, MAX_DAMPING = 1e-9, 1e6  # as in `posterior`


@kernel("f8[:, :, :, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, :, ::1]")
def models(axes: Array, focal: Array, longest: Array, F: Array, tangents: Array) -> None:
    """Fundamental matrices -> F (k, 9), and their derivatives by five rotations and two logarithms -> (k, 9, 7)."""
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


@kernel("f8[:, :, ::1], f8[::1], f8[:, :, ::1], f8[:, ::1], b1, f8, f8[:, :, ::1], f8[:, ::1]")
def posterior(
    products: Array, cost: Array, tangents: Array, focal: Array, same_size: bool, precision: float, hessian: Array,
    gradient: Array,
) -> None:  # fmt: skip
    """The negative logarithm of the posterior, of data costs (k,), in place; derivatives -> (k, 7, 7), (k, 7).

    products: (k, 10, 10), of `sampson_objective_kernels.evaluate` at the models. precision: one over the variance.
    """
    along, work = np.empty((7, 10)), np.empty(4)
    for k in range(len(cost)):
        T = tangents[k]
        for i in range(7):
            for j in range(10):
                total = 0.0
                for q in range(9):
                    total += T[q, i] * products[k, q, j]
                along[i, j] = total
            gradient[k, i] = along[i, 9] * precision
        for i in range(7):
            for j in range(7):
                total = 0.0
                for q in range(9):
                    total += T[q, i] * along[j, q]
                hessian[k, i, j] = total * precision
        cost[k] = cost[k] * precision / 2 + focal_cost(focal[k], same_size, work)
        for i in range(2):
            gradient[k, 5 + i] += work[i]
            for j in range(2):
                hessian[k, 5 + i, 5 + j] += work[2] if i == j else work[3]


@kernel("f8[:, :, :, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[::1], f8[:, :, :, ::1], f8[:, ::1]")
def step(
    axes: Array, focal: Array, hessian: Array, gradient: Array, damping: Array, new_axes: Array, new_focal: Array
) -> None:  # fmt: skip
    """Damped Gauss-Newton steps of candidates with damping (k,) -> new_axes, new_focal."""
    Q = np.empty((7, 8))
    for k in range(len(focal)):
        damped_step(hessian[k], gradient[k], damping[k], Q)
        _rotate(axes[k, 0], Q[0, 7] / 2, Q[1, 7] / 2, Q[2, 7] / 2, new_axes[k, 0])
        _rotate(axes[k, 1], Q[3, 7] / 2, Q[4, 7] / 2, 0.0, new_axes[k, 1])
        for i in range(2):
            new_focal[k, i] = min(max(focal[k, i] + min(max(Q[5 + i, 7], -1.0), 1.0), -3.0), 3.0)


@inner
def damped_step(hessian: Array, gradient: Array, damping: float, Q: Array) -> None:
    """Solves ``(H + damping diag H) x = -gradient`` -> last column of Q (7, 8)."""
    for i in range(7):
        for j in range(7):
            Q[i, j] = hessian[i, j]
        Q[i, i] += hessian[i, i] * damping
        Q[i, 7] = -gradient[i]
    eliminate(Q)


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


@kernel(
    "f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], "
    "f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], "
    "f8[::1], b1[::1], f8"
)
def accept(
    axes: Array, focal: Array, F: Array, cost: Array, gradient: Array, hessian: Array, tangents: Array,
    new_axes: Array, new_focal: Array, new_F: Array, trial: Array, new_gradient: Array, new_hessian: Array,
    new_tangents: Array, damping: Array, done: Array, tolerance: float,
) -> bool:  # fmt: skip
    """Takes the steps that lower the cost, in place; whether all candidates are done.

    tolerance: what the last accepted step of a candidate lowers its cost by, at most; negative: none is ever done.
    """
    everything = True
    for k in range(len(cost)):
        better = trial[k] < cost[k] and not done[k]
        damping[k] = min(max(damping[k] / 10 if better else damping[k] * 10, MIN_DAMPING), MAX_DAMPING)
        if better:
            done[k] |= tolerance >= 0 and cost[k] - trial[k] <= tolerance
            cost[k] = trial[k]
            assign(focal[k], new_focal[k])
            assign(F[k], new_F[k])
            assign(gradient[k], new_gradient[k])
            assign_rows(axes[k, 0], new_axes[k, 0])
            assign_rows(axes[k, 1], new_axes[k, 1])
            assign_rows(hessian[k], new_hessian[k])
            assign_rows(tangents[k], new_tangents[k])
        everything = everything and done[k]
    return everything


@kernel("f8[:, ::1], f8[:, ::1]")
def to_unit_norm(F: Array, out: Array) -> None:
    """Models (k, 9) scaled to unit norm -> out (k, 9)."""
    for k in range(len(F)):
        for i in range(9):
            out[k, i] = F[k, i]
        unit(out[k])
