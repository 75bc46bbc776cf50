"""`focal` for the candidates of one pair, compiled: E and two focal lengths, their posterior, steps of its optimiser.

axes: (k, 2, 3, 3), U and V of ``E = U diag(1, 1, 0) V^T``, rows first. focal: (k, 2), logarithms of focal lengths in
units of the longer sides. longest: (2,), these sides in the unit of the points, which are from the principal points.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.geometry.arithmetic_kernels import exponential, logarithm
from fmtorch.geometry.rank2_kernels import assign, assign_rows, complement, unit
from fmtorch.geometry.rank2_manifold_kernels import eliminate, start_one
from fmtorch.kernels import inner, kernel

Array = NDArray[Any]
USUAL_FOCAL, FOCAL_DEVIATION, RATIO_DEVIATION, SAME_CAMERA, ODDS = 1.2, 0.4, 0.5, 0.01, 5.0  # these as in `focal`
SHORTEST, LONGEST, SMALLEST_DAMPING, LARGEST_DAMPING, SQUARINGS = 0.25, 5.0, 1e-9, 1e6, 5
LOG_USUAL = math.log(USUAL_FOCAL)


@kernel("f8[:, ::1], f8[::1], f8[:, ::1]")
def translate(F: Array, offset: Array, out: Array) -> None:
    """Models (k, 9) for points from which the offset (4,) is taken -> out (k, 9)."""
    for k in range(len(F)):
        for r in range(3):
            a, b = F[k, 3 * r], F[k, 3 * r + 1]
            out[k, 3 * r], out[k, 3 * r + 1] = a, b
            out[k, 3 * r + 2] = F[k, 3 * r + 2] + offset[0] * a + offset[1] * b
        for c in range(3):
            out[k, 6 + c] += offset[2] * out[k, c] + offset[3] * out[k, 3 + c]


@kernel("f8[:, ::1], f8[::1], f8[:, :, :, ::1], f8[:, ::1]")
def start(F: Array, longest: Array, axes: Array, focal: Array) -> None:
    """Cameras near models (k, 9): those of their focal lengths, or of usual ones where these are implausible."""
    G, M, e0, e1 = np.empty(9), np.empty(9), np.empty(3), np.empty(3)
    p, q, a, b = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(F)):
        start_one(F[k], SQUARINGS, G, e0, e1)
        first = _squared_focal(G, 1, 3, e1) / (longest[0] * longest[0])
        second = _squared_focal(G, 3, 1, e0) / (longest[1] * longest[1])
        plausible = SHORTEST**2 < first < LONGEST**2 and SHORTEST**2 < second < LONGEST**2
        focal[k, 0] = logarithm(first) / 2 if plausible else LOG_USUAL
        focal[k, 1] = logarithm(second) / 2 if plausible else LOG_USUAL
        d0 = 1 / (exponential(focal[k, 0]) * longest[0])
        d1 = 1 / (exponential(focal[k, 1]) * longest[1])
        for r in range(3):
            G[3 * r + 2] *= d0
        for c in range(3):
            G[6 + c] *= d1
        start_one(G, 0, M, e0, e1)
        complement(e0, p, q)
        complement(e1, a, b)
        m00, m01, m10, m11 = 0.0, 0.0, 0.0, 0.0
        for r in range(3):
            Mp = M[3 * r] * p[0] + M[3 * r + 1] * p[1] + M[3 * r + 2] * p[2]
            Mq = M[3 * r] * q[0] + M[3 * r + 1] * q[1] + M[3 * r + 2] * q[2]
            m00, m01, m10, m11 = m00 + a[r] * Mp, m01 + a[r] * Mq, m10 + b[r] * Mp, m11 + b[r] * Mq
        sign = 1.0 if m00 * m11 >= m01 * m10 else -1.0
        cosine, sine = m00 + sign * m11, m10 - sign * m01
        norm = math.sqrt(cosine * cosine + sine * sine)
        cosine, sine = cosine / norm, sine / norm
        for r in range(3):
            axes[k, 0, r, 0], axes[k, 0, r, 1] = a[r] * cosine + b[r] * sine, sign * (b[r] * cosine - a[r] * sine)
            axes[k, 1, r, 0], axes[k, 1, r, 1] = p[r], q[r]
            axes[k, 0, r, 2], axes[k, 1, r, 2] = e1[r], e0[r]


@inner
def _squared_focal(F: Array, column: int, row: int, e: Array) -> Any:
    """Bougnoux's formula for the camera whose points F's columns belong to; with steps exchanged, for the other."""
    r0 = -F[0] * e[1] + F[row] * e[0]
    r1 = -F[column] * e[1] + F[row + column] * e[0]
    r2 = -F[2 * column] * e[1] + F[row + 2 * column] * e[0]
    return -(r2 * F[8]) / (r0 * F[2 * row] + r1 * F[2 * row + column])


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


@inner
def _prior(focal: Array, same_size: bool, out: Array) -> Any:
    """The cost of two log focal lengths; its gradient (2) and the two entries of its Hessian -> out (4,)."""
    difference = focal[0] - focal[1]
    squared = difference * difference
    mean = (focal[0] + focal[1]) * (0.5 / FOCAL_DEVIATION) - LOG_USUAL / FOCAL_DEVIATION
    well = (SAME_CAMERA**2 if same_size else 0.0) / (squared + SAME_CAMERA**2)
    precision = 1 / RATIO_DEVIATION**2 + 2 * ODDS / SAME_CAMERA**2 * well * well
    b = 0.5 / FOCAL_DEVIATION
    pull = precision * difference
    out[0], out[1], out[2], out[3] = b * mean + pull, b * mean - pull, b * b + precision, b * b - precision
    return mean * mean / 2 + squared / (2 * RATIO_DEVIATION**2) - ODDS * well


@kernel("f8[:, ::1], b1, f8[::1]")
def prior_costs(focal: Array, same_size: bool, out: Array) -> None:
    """The negative logarithm of the prior of focal lengths (k, 2) -> out (k,)."""
    work = np.empty(4)
    for k in range(len(focal)):
        out[k] = _prior(focal[k], same_size, work)


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
        cost[k] = cost[k] * precision / 2 + _prior(focal[k], same_size, work)
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
        _equations(hessian[k], gradient[k], damping[k], Q)
        _rotate(axes[k, 0], Q[0, 7] / 2, Q[1, 7] / 2, Q[2, 7] / 2, new_axes[k, 0])
        _rotate(axes[k, 1], Q[3, 7] / 2, Q[4, 7] / 2, 0.0, new_axes[k, 1])
        for i in range(2):
            new_focal[k, i] = min(max(focal[k, i] + min(max(Q[5 + i, 7], -1.0), 1.0), -3.0), 3.0)


@inner
def _equations(hessian: Array, gradient: Array, damping: float, Q: Array) -> None:
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


@kernel("f8[:, :, ::1], f8[:, ::1], f8[:, ::1], b1, f8, f8[::1]")
def gain_without_prior(
    hessian: Array, gradient: Array, focal: Array, same_size: bool, damping: float, out: Array
) -> None:  # fmt: skip
    """What the logarithm of the likelihood would rise by at an optimum without prior -> out (k,)."""
    Q, H, g, work = np.empty((7, 8)), np.empty((7, 7)), np.empty(7), np.empty(4)
    for k in range(len(focal)):
        _prior(focal[k], same_size, work)
        for i in range(7):
            g[i] = gradient[k, i] - (work[i - 5] if i >= 5 else 0.0)
            for j in range(7):
                own = work[2] if i == j else work[3]
                H[i, j] = hessian[k, i, j] - (own if i >= 5 and j >= 5 else 0.0)
        _equations(H, g, damping, Q)
        total = 0.0
        for i in range(7):
            total += g[i] * Q[i, 7]
        out[k] = -total / 2


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

    tolerance: what the last step of a candidate lowers its cost by, at most; negative: none is ever done.
    """
    everything = True
    for k in range(len(cost)):
        better = trial[k] < cost[k] and not done[k]
        damping[k] = min(max(damping[k] / 10 if better else damping[k] * 10, SMALLEST_DAMPING), LARGEST_DAMPING)
        done[k] |= tolerance >= 0 and cost[k] - trial[k] <= tolerance
        if better:
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
