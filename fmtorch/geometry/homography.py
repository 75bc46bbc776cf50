"""Homographies and the planes they stand for, component by component: a result has the same bits in any batch.

``x1 ~ H x0``. Models are (9, *s), entries row by row; points (4, n, *s), rows x0, y0, x1, y1.
Hartley & Zisserman (2004), Multiple View Geometry, chapters 4 and 13.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import as_rows, component_sum, cross, matmul3, sqrt, stable_sum
from fmtorch.geometry.eigenvector import smallest_eigenvector
from fmtorch.geometry.normalize import normalize_points


def least_squares_homography(
    points: Float[Tensor, "4 p n"], weight: Float[Tensor, "p n"]
) -> tuple[Float[Tensor, "9 p"], Bool[Tensor, " p"]]:
    """The homography of least weighted algebraic error of normalised points, float64, and whether it is determined.

    The normalised DLT, algorithm 4.2; finite points, also where the weight is 0.
    """
    w = weight.to(torch.float64)
    (x0, T0), (x1, T1) = (
        normalize_points(x.to(torch.float64).permute(1, 2, 0), weight=w) for x in (points[:2], points[2:])
    )
    rows = _equations(torch.cat([x0, x1], -1).movedim(-1, 0)[:, None])[:, 0]  # (2, 9, p, n)
    M = component_sum(torch.stack([stable_sum((w * row)[:, None] * row, -1) for row in rows]))
    normalised, determined = smallest_eigenvector(M.movedim(-1, 0).contiguous())
    back = _adjugate(T1.flatten(1).T).T.reshape(-1, 3, 3)
    H = matmul3(matmul3(back, normalised.reshape(-1, 3, 3)), T0)
    return H.flatten(1).T.contiguous(), determined


def transfer_squared(H: Float[Tensor, "9 p m"], points: Float[Tensor, "4 p n"]) -> Float[Tensor, "p m n"]:
    """The greater of the squared distances from H x0 to x1 and from H^-1 x1 to x0; infinite where these are."""
    x0, y0, x1, y1 = points[:, :, None]
    return torch.maximum(_squared(H, x0, y0, x1, y1), _squared(_adjugate(H), x1, y1, x0, y0))


def plane_homography(
    F: Float[Tensor, " 9 *s"], e1: Float[Tensor, " 3 *s"], points: Float[Tensor, "4 3 *s"]
) -> tuple[Float[Tensor, " 9 *s"], Bool[Tensor, "*s"]]:
    """The homography of the plane through three matches of a fundamental matrix, and whether it is determined.

    ``H = A - e1 (M^-1 b)^T`` with ``A = [e1]_x F``, the rows of M the points in image 0, and
    ``b_i = (x1_i x (A x0_i)) . (x1_i x e1) / |x1_i x e1|^2`` (result 13.6). e1: the epipole in image 1, ``F^T e1 = 0``.
    """
    A = cross_times(e1, F)
    h0, h1 = _homogeneous(points[:2]), _homogeneous(points[2:])  # (3, 3 points, *s)
    Ax = component_sum(A.reshape(3, 3, 1, *A.shape[1:]) * h0, 1)
    across = cross(h1, e1[:, None].expand_as(h1))
    length2 = component_sum(across * across)
    b = component_sum(cross(h1, Ax) * across) / torch.where(length2 > 0, length2, 1.0)
    # Cramer's rule: M^-1 b with the points as rows of M, whose inverse has the cross products of the rows as columns.
    p, q, r = h0.unbind(1)
    qr, rp, pq = cross(q, r), cross(r, p), cross(p, q)
    determinant = component_sum(p * qr)
    valid = (length2 > 0).all(0) & (determinant != 0)
    v = (b[0] * qr + b[1] * rp + b[2] * pq) / torch.where(valid, determinant, 1.0)
    H = A - (e1[:, None] * v).flatten(0, 1)
    return torch.where(valid, H, 0.0), valid


def plane_and_parallax(
    H: Float[Tensor, " 9 *s"], points: Float[Tensor, "4 2 *s"]
) -> tuple[Float[Tensor, " 9 *s"], Bool[Tensor, "*s"]]:
    """The fundamental matrix of a plane's homography and two matches off the plane, of unit norm, and whether there is.

    ``F = [e1]_x H``: the lines through x1 and H x0 of both matches meet in the epipole e1 (section 13.2).
    """
    h0, h1 = _homogeneous(points[:2]), _homogeneous(points[2:])
    moved = component_sum(H.reshape(3, 3, 1, *H.shape[1:]) * h0, 1)
    lines = cross(h1, moved)
    F = cross_times(cross(lines[:, 0], lines[:, 1]), H)
    norm2 = component_sum(F * F)
    size2 = component_sum(lines[:, 0].square()) * component_sum(lines[:, 1].square()) * component_sum(H * H)
    rounding = 16 * torch.finfo(F.dtype).eps  # of cross products that should vanish, as of a match taken twice
    valid = (norm2 > rounding**2 * size2) & norm2.isfinite()
    return torch.where(valid, F / sqrt(torch.where(valid, norm2, 1.0)), 0.0), valid


def cross_times(e: Float[Tensor, " 3 *s"], A: Float[Tensor, " 9 *s"]) -> Float[Tensor, " 9 *s"]:
    """``[e]_x A``: the cross product of e with each column of A."""
    rows = as_rows(A)
    return cross(e[:, None].expand_as(rows), rows).flatten(0, 1)


def _homogeneous(x: Float[Tensor, "2 n *s"]) -> Float[Tensor, "3 n *s"]:
    return torch.cat([x, torch.ones_like(x[:1])])


def _equations(points: Float[Tensor, "4 n *s"]) -> Float[Tensor, "2 n 9 *s"]:
    """The two rows a match gives, (0, -h0, y1 h0) and (h0, 0, -x1 h0), h0 the point of image 0 (equation 4.3)."""
    x0, y0, x1, y1 = points
    one, zero = torch.ones_like(x0), torch.zeros_like(x0)
    first = torch.stack([zero, zero, zero, -x0, -y0, -one, y1 * x0, y1 * y0, y1], 1)
    second = torch.stack([x0, y0, one, zero, zero, zero, -x1 * x0, -x1 * y0, -x1], 1)
    return torch.stack([first, second])


def _squared(H: Tensor, x: Tensor, y: Tensor, u: Tensor, v: Tensor) -> Float[Tensor, "p m n"]:
    h = H[..., None]
    depth = h[6] * x + h[7] * y + h[8]
    du = (h[0] * x + h[1] * y + h[2]) / depth - u
    dv = (h[3] * x + h[4] * y + h[5]) / depth - v
    return (du * du + dv * dv).nan_to_num(nan=torch.inf, posinf=torch.inf)


def _adjugate(H: Float[Tensor, " 9 *s"]) -> Float[Tensor, " 9 *s"]:
    """A multiple of the inverse: the transposed cofactors."""
    rows = as_rows(H)
    return torch.stack([cross(rows[1], rows[2]), cross(rows[2], rows[0]), cross(rows[0], rows[1])], 1).flatten(0, 1)
