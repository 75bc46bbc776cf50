"""The manifold of 3 x 3 matrices of rank 2 and unit norm: a start on it, steps in its tangent space, the way back.

The tangent space at F is what is orthogonal, in R^9, to F (scale) and to ``e1 e0^T`` (rank), with ``F e0 = 0`` and
``F^T e1 = 0`` the epipoles. This is the orthonormal parametrisation of Bartoli & Sturm (2004) to first order, without
its rotations, and without its defect where the singular values coincide."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.arithmetic import as_rows, cofactors, component_sum, unit
from fmtorch.geometry.levenberg_marquardt import SQUARINGS, Weighted, evaluate
from fmtorch.geometry.matrices import assign, cofactors_kernel, unit_kernel
from fmtorch.jit.kernel import Array, F8x1, F8x2, inner, kernel, matrix, vector
from fmtorch.jit.lanes import LANES, load, store

RANK_TWO, RANK_TWO_EPIPOLE = (0.5**0.5, 0.0, 0.0, 0.0, 0.5**0.5, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def constrained_solve(
    H: Float[Tensor, "9 9 p k"], F: Tensor, e0: Tensor, e1: Tensor, damping: Tensor, right: Float[Tensor, "9 r p k"]
) -> Float[Tensor, "9 r p k"]:
    """Solve ``(H + damping c I) x = right`` for x orthogonal to ``e1 e0^T`` by Gauss-Jordan elimination.
    The constraint has a row and a column of its own; H is positive semidefinite, so that no pivoting is needed.
    Along F, to which the residual is blind, H is given the curvature c."""
    normal = (e1[:, None] * e0).flatten(0, 1)
    curvature = H.diagonal(dim1=0, dim2=1).amax(-1)
    Q = H.new_zeros(10, 10 + right.shape[1], *F.shape[1:])
    torch.add(H, (curvature * F)[:, None] * F, out=Q[:9, :9])
    Q[:9, :9].diagonal(dim1=0, dim2=1).add_((curvature * damping)[..., None])
    Q[:9, 9] = Q[9, :9] = normal
    Q[:9, 10:] = right
    for i in range(10):
        column, rest = Q.tensor_split((1,), 1)
        row = rest[i] / column[i]
        Q = torch.addcmul(rest, column, row, value=-1)
        Q[i] = row
    return Q[:9]


def retract(F: Tensor, step: Tensor, e0: Tensor, e1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The rank-2 matrix of unit norm ``F + step + alpha e1 e0^T``, and its epipoles."""
    G = F + step
    C = cofactors(as_rows(G)).flatten(0, 1)
    determinant = component_sum(C[:3] * G[:3])
    normal = (e1[:, None] * e0[None]).flatten(0, 1)
    G = unit(G - determinant / component_sum(C * normal) * normal)
    C = cofactors(as_rows(G))  # a multiple of e1 e0^T
    return G, unit(component_sum(C * e1[:, None])), unit(component_sum(C * e0, 1))


def start(F: Float[Tensor, "9 p k"]) -> tuple[Tensor, Tensor, Tensor]:
    """A rank-2 matrix of unit norm close to F and its epipoles: ``F (I - e0 e0^T)``.
    e0 is the right singular vector of the smallest singular value, by squarings of the matrix whose dominant
    eigenvector it is: with five to rounding where the last two singular values differ by half, with none where F has
    rank 2 up to rounding already. The result has rank 2 in any case."""
    F = unit(F)
    C = cofactors(as_rows(F))
    K = component_sum(C[:, :, None] * C[:, None])  # C^T C
    for _ in range(SQUARINGS):
        K = K / K.abs().amax((0, 1))
        K = component_sum(K[:, :, None] * K[:, None])
    size = component_sum(K * K, 1)
    column = size.argmax(0)
    e0 = unit(K.gather(0, column.expand(1, 3, *column.shape))[0])
    M = as_rows(F)
    G = unit((M - component_sum(M * e0, 1)[:, None] * e0).flatten(0, 1))
    return G, e0, unit(component_sum(cofactors(as_rows(G)) * e0, 1))


def constant(like: Tensor, components: tuple[float, ...]) -> Tensor:
    """Fixed components, to broadcast against models (c, p, k)."""
    return like.new_tensor(components)[:, None, None]


# Unit matrices of rank 2, for the models of one pair: starts, steps, and how an optimum moves


@inner
def start_one(F: Array, squarings: int, G: Array, e0: Array, e1: Array) -> None:
    """The unit matrix of rank 2 near a model (9,) -> G, and its epipoles -> e0, e1 (3,).
    squarings: of the matrix whose columns tend to the null vector; more for models that are farther from rank 2."""
    C, K, P = vector(9), matrix(3, 3), matrix(3, 3)
    for i in range(9):
        G[i] = F[i]
    unit_kernel(G)
    cofactors_kernel(G, C)
    for r in range(3):
        for c in range(3):
            K[r, c] = C[r] * C[c] + C[3 + r] * C[3 + c] + C[6 + r] * C[6 + c]
    for _ in range(squarings):
        peak = 0.0
        for r in range(3):
            for c in range(3):
                peak = max(peak, abs(K[r, c]))
        for r in range(3):
            for c in range(3):
                P[r, c] = K[r, c] / peak
        for r in range(3):
            for c in range(3):
                K[r, c] = P[0, r] * P[0, c] + P[1, r] * P[1, c] + P[2, r] * P[2, c]
    best, most = 0, -1.0
    for r in range(3):
        size = K[r, 0] * K[r, 0] + K[r, 1] * K[r, 1] + K[r, 2] * K[r, 2]
        if size > most:
            best, most = r, size
    for c in range(3):
        e0[c] = K[c, best]
    unit_kernel(e0)
    for r in range(3):
        along = G[3 * r] * e0[0] + G[3 * r + 1] * e0[1] + G[3 * r + 2] * e0[2]
        for c in range(3):
            G[3 * r + c] -= along * e0[c]
    unit_kernel(G)
    cofactors_kernel(G, C)
    for r in range(3):
        e1[r] = C[3 * r] * e0[0] + C[3 * r + 1] * e0[1] + C[3 * r + 2] * e0[2]
    unit_kernel(e1)


@kernel(holds_gil=True)
def gauss_newton(F: F8x1, matches: Weighted, damping: float, out: F8x1) -> None:
    """One damped Gauss-Newton step of a model (9,) on the manifold -> out (9,), of unit norm."""
    at, e0, e1 = matrix(1, 9), matrix(1, 3), matrix(1, 3)
    moved, g0, g1 = matrix(1, 9), matrix(1, 3), matrix(1, 3)
    products, cost = np.empty((1, 10, 10)), vector(1)
    start_one(F, SQUARINGS, at[0], e0[0], e1[0])
    evaluate(at, matches, True, products, cost)
    steps(products, at, e0, e1, np.full(1, damping), moved, g0, g1)
    assign(out, moved[0])


@kernel(holds_gil=True)
def response(F: F8x1, matches: Weighted, damping: float, out: F8x2) -> None:
    """How an optimum (9,) moves with the gradient of its cost by the nine entries -> out (9, 9), minus inverse Hessian.
    By the implicit function theorem, in the tangent space of the manifold, with Gauss and Newton's Hessian."""
    at, e0, e1 = matrix(1, 9), matrix(1, 3), matrix(1, 3)
    products, cost, Q = np.empty((1, 10, 10)), vector(1), np.zeros((20, LANES))
    start_one(F, SQUARINGS, at[0], e0[0], e1[0])
    evaluate(at, matches, True, products, cost)
    for j in range(9):
        _system(products[0], at[0], e0[0], e1[0], damping, Q)
        for r in range(10):
            Q[2 * r + 1, 10 - LANES] = -1.0 if r == j else 0.0
        eliminate(Q, 10)
        for i in range(9):
            out[i, j] = Q[2 * i + 1, 10 - LANES]


@inner
def steps(
    products: Array, F: Array, e0: Array, e1: Array, damping: Array, G: Array, g0: Array, g1: Array
) -> None:  # fmt: skip
    """Damped Gauss-Newton steps of models (k, 9), epipoles (k, 3) -> G (k, 9), g0, g1 (k, 3), again of rank 2.
    products: (k, 10, 10), of `levenberg_marquardt.evaluate`. damping: (k,)."""
    Q, C = np.zeros((20, LANES)), vector(9)
    for k in range(len(F)):
        _system(products[k], F[k], e0[k], e1[k], damping[k], Q)
        for r in range(9):
            Q[2 * r + 1, 10 - LANES] = -products[k, r, 9]
        Q[19, 10 - LANES] = 0.0
        eliminate(Q, 10)
        for i in range(9):
            G[k, i] = F[k, i] + Q[2 * i + 1, 10 - LANES]
        _retract(G[k], e0[k], e1[k], g0[k], g1[k], C)


@inner
def _system(products: Array, F: Array, e0: Array, e1: Array, damping: float, Q: Array) -> None:
    """The damped normal equations of a model, with the constraint, no right side -> Q, (10, 11) in rows of LANES."""
    damped_system(products, F, damping, Q)
    for r in range(9):
        normal = e1[r // 3] * e0[r % 3]
        Q[2 * r + 1, 9 - LANES], Q[18 + r // LANES, r % LANES] = normal, normal
    Q[19, 9 - LANES] = 0.0


@inner
def damped_system(products: Array, x: Array, damping: float, Q: Array) -> None:
    """The damped normal equations of nine entries x (9,), to whose scale the residual is blind -> the first nine rows
    of Q, in two rows of LANES each, without right side."""
    curvature = 0.0
    for i in range(9):
        curvature = max(curvature, products[i, i])
    for r in range(9):
        for c in range(9):
            Q[2 * r + c // LANES, c % LANES] = products[r, c] + curvature * x[r] * x[c]
        Q[2 * r + r // LANES, r % LANES] += curvature * damping


@inner
def damped_step(hessian: Array, gradient: Array, damping: float, Q: Array, x: Array) -> None:
    """Solves ``(H + damping diag H) x = -gradient`` of n parameters -> x (n,). Q: for the work, each row of the system,
    (n, n + 1), being one or more of LANES numbers."""
    n = len(x)
    wide = len(Q) // n
    for r in range(n):
        for c in range(n):
            Q[wide * r + c // LANES, c % LANES] = hessian[r, c]
        Q[wide * r + r // LANES, r % LANES] += hessian[r, r] * damping
        Q[wide * r + n // LANES, n % LANES] = -gradient[r]
    eliminate(Q, n)
    for r in range(n):
        x[r] = Q[wide * r + n // LANES, n % LANES]


@inner
def eliminate(Q: Array, n: int) -> None:
    """Gauss-Jordan elimination of (n, n + 1) without pivoting, in place: the solution is the last column.
    Each row of the matrix is one or more of Q's rows of LANES."""
    wide = len(Q) // n
    for i in range(n):
        first, lane = i // LANES, i % LANES
        pivot = Q[i * wide + first, lane]
        for w in range(i * wide + first, (i + 1) * wide):
            store(Q, w, load(Q, w) / pivot)
        for r in range(n):
            if r != i:
                factor = Q[r * wide + first, lane]
                for w in range(first, wide):
                    store(Q, r * wide + w, load(Q, r * wide + w) - factor * load(Q, i * wide + w))


@inner
def _retract(G: Array, e0: Array, e1: Array, g0: Array, g1: Array, C: Array) -> None:
    """G made rank 2 along ``e1 e0^T`` and of unit norm, in place; its epipoles -> g0, g1."""
    cofactors_kernel(G, C)
    determinant, along = C[0] * G[0] + C[1] * G[1] + C[2] * G[2], 0.0
    for i in range(9):
        along += C[i] * (e1[i // 3] * e0[i % 3])
    for i in range(9):
        G[i] -= determinant / along * (e1[i // 3] * e0[i % 3])
    unit_kernel(G)
    cofactors_kernel(G, C)
    for c in range(3):
        g0[c] = C[c] * e1[0] + C[3 + c] * e1[1] + C[6 + c] * e1[2]
        g1[c] = C[3 * c] * e0[0] + C[3 * c + 1] * e0[1] + C[3 * c + 2] * e0[2]
    unit_kernel(g0)
    unit_kernel(g1)
