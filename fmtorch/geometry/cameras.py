"""Fundamental matrices from cameras, ``x1^T F x0 = 0``, image 0 first.

Matrices are of any scale and sign, leading dimensions broadcast, and a result is bit-equal whatever stands beside it in
the batch, as in `epipolar`.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.arithmetic import matmul3
from fmtorch.geometry.epipolar import unit_frobenius, unit_largest


def cross_matrix(t: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The skew-symmetric matrix [t]_x with ``[t]_x v = t x v``."""
    x, y, z = t.unbind(-1)
    zero = torch.zeros_like(x)
    return _matrix([zero, -z, y, z, zero, -x, -y, x, zero])


def fundamental_from_projections(
    P0: Float[Tensor, "*#batch 3 4"], P1: Float[Tensor, "*#batch 3 4"]
) -> Float[Tensor, "*#batch 3 3"]:
    """F of unit Frobenius norm between two cameras: ``F = [P1 C]_x P1 P0^+`` with ``P0 C = 0``, without a null space.

    Each element is a 4 x 4 determinant of two rows of P0 and two of P1 (Hartley & Zisserman, Multiple View Geometry,
    2nd ed., eq. 17.3), so it holds for finite and infinite cameras and is smooth in both. Cameras with one centre
    have no fundamental matrix: the zero matrix is returned.

    Args:
        P0: projection (..., 3, 4) of image 0, world to pixels, of any scale.
        P1: that of image 1; leading dimensions broadcast.

    Returns:
        (..., 3, 3).
    """
    lines0, lines1 = _pluecker_of_row_pairs(unit_largest(P0)), _pluecker_of_row_pairs(unit_largest(P1))
    # The sign is that of [t]_x for P0 = [I | 0], P1 = [I | t].
    return unit_frobenius(_matrix([-_determinant(lines0[i], lines1[j]) for j in range(3) for i in range(3)]))


def fundamental_from_calibration(
    K0: Float[Tensor, "*#batch 3 3"],
    K1: Float[Tensor, "*#batch 3 3"],
    R: Float[Tensor, "*#batch 3 3"],
    t: Float[Tensor, "*#batch 3"],
) -> Float[Tensor, "*#batch 3 3"]:
    """F = K1^-T [t]_x R K0^-1 of unit Frobenius norm, for ``X1 = R X0 + t`` (Hartley & Zisserman, eq. 9.12).

    Args:
        K0: calibration matrix (..., 3, 3) of image 0.
        K1: that of image 1.
        R: rotation (..., 3, 3) from camera 0 to camera 1.
        t: translation (..., 3), of any length but zero.

    Returns:
        (..., 3, 3).

    Example:
        >>> import torch
        >>> from fmtorch.geometry import algebraic, fundamental_from_calibration
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> F = fundamental_from_calibration(K, K, torch.eye(3), torch.tensor([1.0, 0, 0]))  # a step to the right
        >>> x0, x1 = torch.tensor([[100.0, 50]]), torch.tensor([[60.0, 50]])  # the same row
        >>> bool(algebraic(F, x0, x1).abs() < 1e-6)
        True
    """
    E = matmul3(cross_matrix(t), R)
    inverse0 = _cofactors(unit_largest(K0)).mT  # K^-1 up to the scale det K
    inverse1_t = _cofactors(unit_largest(K1))
    return unit_frobenius(matmul3(matmul3(inverse1_t, unit_largest(E)), inverse0))


def _matrix(elements: list[Tensor]) -> Tensor:
    """A 3 x 3 matrix from its nine elements, row by row."""
    stacked = torch.stack(elements, -1)
    return stacked.reshape(*stacked.shape[:-1], 3, 3)


def _cofactors(matrix: Tensor) -> Tensor:
    """det(M) M^-T: each element is the minor of the rows and columns that follow it cyclically."""
    roll = matrix.roll
    return roll((-1, -1), (-2, -1)) * roll((-2, -2), (-2, -1)) - roll((-1, -2), (-2, -1)) * roll((-2, -1), (-2, -1))


def _pluecker_of_row_pairs(P: Tensor) -> list[list[Tensor]]:
    """For i = 0, 1, 2 the minors of the two rows of P other than i, in cyclic order: columns 01, 02, 03, 12, 13, 23."""
    columns = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    rows = [(1, 2), (2, 0), (0, 1)]
    return [[P[..., r, a] * P[..., s, b] - P[..., r, b] * P[..., s, a] for a, b in columns] for r, s in rows]


def _determinant(line0: list[Tensor], line1: list[Tensor]) -> Tensor:
    """The 4 x 4 determinant of two rows above two others, by Laplace expansion in 2 x 2 minors."""
    (a01, a02, a03, a12, a13, a23), (b01, b02, b03, b12, b13, b23) = line0, line1
    return a01 * b23 - a02 * b13 + a03 * b12 + a12 * b03 - a13 * b02 + a23 * b01
