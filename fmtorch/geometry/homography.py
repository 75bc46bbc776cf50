"""Homographies ``x1 ~ H x0`` in tensors: of four and more matches, and the distances of matches to them.

Points are (..., N, 2) in pixels, matrices (..., 3, 3) of any scale and sign; leading dimensions broadcast. Hartley &
Zisserman (2004), Multiple View Geometry, chapter 4.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import cofactors, determinant, matmul3, stable_sum
from fmtorch.geometry.eigenvector import smallest_eigenvector
from fmtorch.geometry.eight_point import finite_matches
from fmtorch.geometry.epipolar import inverse_root, lines_through, unit_frobenius, unit_largest
from fmtorch.geometry.homography_error import linearise_homography
from fmtorch.geometry.normalize import normalize_points

SINGULAR = 1e-12  # determinant of a matrix of unit norm, between normalised points, that counts as zero


def homography(
    x0: Float[Tensor, "*batch n 2"],
    x1: Float[Tensor, "*batch n 2"],
    weight: Float[Tensor, "*batch n"] | None = None,
    mask: Bool[Tensor, "*batch n"] | None = None,
) -> tuple[Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:
    """The homography of N >= 4 correspondences by weighted linear least squares, and whether it is valid.

    The normalised DLT (Hartley & Zisserman, algorithm 4.2), exact for four matches: H is the smallest eigenvector of
    the sum of w times the two equations' products, denormalised, of unit Frobenius norm. The third coordinate of H x0
    is positive at the matches, by majority of their weights. Differentiable in points and weights. Computed in
    float64, returned in x0's type.

    Args:
        x0: points of image 0, pixels.
        x1: their matches in image 1.
        weight: of each match, not negative, any scale; 1 by default.
        mask: True for a real match; all by default.

    Returns:
        H, and whether it is valid. Invalid (H = 0): fewer than eight independent equations (too few points, coincident
        ones, or all but one on a line), a singular H, or anything not finite, or a negative weight, among the unmasked
        points. The result has the same bits in any batch and with any padding.

    Example:
        >>> import torch
        >>> from fmtorch.geometry import homography, homography_transfer
        >>> x0 = torch.tensor([[0.0, 0.0], [640.0, 0.0], [640.0, 480.0], [0.0, 480.0]], dtype=torch.float64)
        >>> x1 = torch.tensor([[10.0, 20.0], [600.0, 40.0], [610.0, 450.0], [30.0, 400.0]], dtype=torch.float64)
        >>> H, valid = homography(x0, x1)
        >>> bool(valid), bool((homography_transfer(H, x0, x1)[1] < 1e-6).all())
        (True, True)
    """
    a, b, w, finite = finite_matches(x0, x1, weight, mask)
    (a, T0), (b, T1) = normalize_points(a, weight=w), normalize_points(b, weight=w)
    h, determined = smallest_eigenvector(_normal_matrix(a, b, w))
    linear = h.reshape(*h.shape[:-1], 3, 3)
    depth = lines_through(linear.detach(), a.detach())[2]
    side = stable_sum(torch.where(depth > 0, w, -w).detach(), -1)
    regular = determinant(linear.detach().movedim((-2, -1), (0, 1))).abs() > SINGULAR
    H = unit_frobenius(matmul3(matmul3(_inverse_similarity(T1), linear), T0))
    H = torch.where((side < 0)[..., None, None], -H, H)
    valid = finite & determined & regular
    return torch.where(valid[..., None, None], H, 0.0).to(x0.dtype), valid


def homography_points(
    H: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*#batch n 2"]:
    """The points of image 1 that H maps x0 to, in pixels; infinite on its horizon.

    Args:
        H: homographies (..., 3, 3), of any scale and sign.
        x0: points in image 0, (..., N, 2), px.

    Returns:
        (..., N, 2).
    """
    X, Y, W = lines_through(unit_largest(H), x0)
    seen = W != 0
    by = 1 / torch.where(seen, W, 1.0)
    return torch.where(seen[..., None], torch.stack([X * by, Y * by], -1), torch.inf)


def homography_transfer(
    H: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"]
) -> tuple[Float[Tensor, "*#batch n"], Float[Tensor, "*#batch n"]]:
    """Transfer distances in pixels: from ``H^-1 x1`` to x0 in image 0, from ``H x0`` to x1 in image 1.

    Infinite on a horizon, and in image 0 where H is singular. Their squares add up to the symmetric transfer error
    (Hartley & Zisserman, eq. 4.7).

    Args:
        H: homographies (..., 3, 3), of any scale and sign.
        x0: points in image 0, (..., N, 2), px.
        x1: their matches in image 1, (..., N, 2), px.

    Returns:
        Two tensors (..., N), at least 0: in image 0, in image 1.

    Example:
        >>> import torch
        >>> from fmtorch.geometry import homography_transfer
        >>> H = torch.diag(torch.tensor([2.0, 2.0, 1.0]))
        >>> [float(d) for d in homography_transfer(H, torch.tensor([[10.0, 20.0]]), torch.tensor([[20.0, 46.0]]))]
        [3.0, 6.0]
    """
    adjugate = cofactors(unit_largest(H).movedim((-2, -1), (0, 1))).movedim((0, 1), (-1, -2))
    return _distance(homography_points(adjugate, x1), x0), _distance(homography_points(H, x0), x1)


def homography_sampson(
    H: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*#batch n"]:
    """Sampson distance of a homography in pixels: of both images together (Hartley & Zisserman, section 4.2.6).

    The length of the least correction of x0 and x1 that makes ``x1 ~ H x0`` hold to first order: of small errors the
    distance to the nearest exact match.

    Args:
        H: homographies (..., 3, 3), of any scale and sign.
        x0: points in image 0, (..., N, 2), px.
        x1: their matches in image 1, (..., N, 2), px.

    Returns:
        (..., N), at least 0.
    """
    h = unit_largest(H.to(torch.float64)).flatten(-2).movedim(-1, 0)[..., None]
    shape = np.broadcast_shapes(x0.shape, x1.shape)
    points = torch.cat([x0.expand(shape), x1.expand(shape)], -1).movedim(-1, 0)
    squared = linearise_homography(h, points.to(torch.float64)).squared  # of the fourth degree in the coordinates
    return (squared * inverse_root(squared)).to(x0.dtype)


def _distance(x: Tensor, y: Tensor) -> Tensor:
    """Between points (..., N, 2); a distance of zero has gradient zero."""
    apart = torch.isfinite(x).all(-1)
    dx, dy = torch.where(apart[..., None], x - y, 0.0).unbind(-1)
    squared = dx * dx + dy * dy
    return torch.where(apart, squared * inverse_root(squared), torch.inf)


def _normal_matrix(x0: Tensor, x1: Tensor, w: Tensor) -> Float[Tensor, "*batch 9 9"]:
    """The sum of w a a^T over both rows (0, -h, y1 h) and (h, 0, -x1 h) that a match gives, h its point of image 0."""
    h = torch.cat([x0, torch.ones_like(x0[..., :1])], -1).mT  # (*batch, 3, n)
    products = h[..., :, None, :] * (w[..., None, :] * h)[..., None, :, :]
    x, y = (c[..., None, None, :] for c in x1.unbind(-1))
    S, X, Y, R = (stable_sum(products * by, -1) for by in (torch.ones_like(x), -x, -y, x * x + y * y))
    zero = torch.zeros_like(S)
    return torch.cat([torch.cat(row, -1) for row in ((S, zero, X), (zero, S, Y), (X, Y, R))], -2)


def _inverse_similarity(T: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """A multiple of the inverse of [s, 0, tx; 0, s, ty; 0, 0, 1]."""
    zero, s = torch.zeros_like(T[..., 0, 0]), T[..., 0, 0]
    rows = [torch.ones_like(s), zero, -T[..., 0, 2], zero, torch.ones_like(s), -T[..., 1, 2], zero, zero, s]
    return torch.stack(rows, -1).reshape(T.shape)
