"""The manifold of 3 x 3 matrices of rank 2 and unit norm: a start on it, steps in its tangent space, the way back.

The tangent space at F is what is orthogonal, in R^9, to F (scale) and to ``e1 e0^T`` (rank), with ``F e0 = 0`` and
``F^T e1 = 0`` the epipoles. This is the orthonormal parametrisation of Bartoli & Sturm (2004) to first order, without
its rotations, and without its defect where the singular values coincide.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.arithmetic import as_rows, cofactors, component_sum, unit

RANK_TWO, RANK_TWO_EPIPOLE = (0.5**0.5, 0.0, 0.0, 0.0, 0.5**0.5, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
SQUARINGS = 5  # enough for any matrix whose last two singular values differ by half


def constrained_solve(
    H: Float[Tensor, "9 9 p k"], F: Tensor, e0: Tensor, e1: Tensor, damping: Tensor, right: Float[Tensor, "9 r p k"]
) -> Float[Tensor, "9 r p k"]:
    """Solve ``(H + damping c I) x = right`` for x orthogonal to ``e1 e0^T`` by Gauss-Jordan elimination.

    The constraint has a row and a column of its own; H is positive semidefinite, so that no pivoting is needed.
    Along F, to which the residual is blind, H is given the curvature c.
    """
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


def start(F: Float[Tensor, "9 p k"], squarings: int = SQUARINGS) -> tuple[Tensor, Tensor, Tensor]:
    """A rank-2 matrix of unit norm close to F and its epipoles: ``F (I - e0 e0^T)``.

    e0 is the right singular vector of the smallest singular value, by squarings of the matrix whose dominant
    eigenvector it is: with five to rounding where the last two singular values differ by half, with none where F has
    rank 2 up to rounding already. The result has rank 2 in any case.
    """
    F = unit(F)
    C = cofactors(as_rows(F))
    K = component_sum(C[:, :, None] * C[:, None])  # C^T C
    for _ in range(squarings):
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
