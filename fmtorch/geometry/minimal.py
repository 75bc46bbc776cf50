"""The seven-point algorithm as a component-first core, over many samples at once.

Points come as (4, n, *s): the rows x0, y0, x1, y1, then the points of a sample, then any sample axes. Every operation
is element-wise over the samples, so a sample's result has the same bits whatever stands beside it. A sample that is
degenerate (repeated points, rank-deficient equations, NaN) is not valid, and its F is zero.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import determinant, sqrt
from fmtorch.geometry.cubic import cubic_roots
from fmtorch.geometry.nullspace import null_space


def seven_point_components(
    points: Float[Tensor, " 4 7 *s"],
) -> tuple[Float[Tensor, " 9 3 *s"], Bool[Tensor, " 3 *s"]]:
    """Up to three fundamental matrices of seven correspondences, unit Frobenius norm, and which slots hold one.

    The equations' null space is spanned by F0 and F1; det(a F0 + b F1) = 0 is a cubic, solved in float64 (Hartley and
    Zisserman, Multiple View Geometry, 11.1.2). The points should be normalised to about unit scale.
    """
    points, finite = _finite(points)
    basis, full_rank = null_space(_equations(points))
    F0, F1, coefficients = _cubic(basis)
    roots, real = cubic_roots(coefficients)
    cosine = 1.0 / sqrt(1.0 + roots * roots)
    a, b = cosine.to(points.dtype), (roots * cosine).to(points.dtype)
    valid = real & full_rank & finite
    F = a * F0[:, None] + b * F1[:, None]
    return torch.where(valid, F, 0.0), valid


def _finite(points: Tensor) -> tuple[Tensor, Tensor]:
    """Points with zeros for what is not finite, and which samples are wholly finite."""
    return points.nan_to_num(0.0, 0.0, 0.0), points.detach().abs().amax((0, 1)).isfinite()


def _equations(points: Tensor) -> Tensor:
    """The rows a with a . vec(F) = x1^T F x0: (n, 9, *s)."""
    x0, y0, x1, y1 = points
    return torch.stack([x1 * x0, x1 * y0, x1, y1 * x0, y1 * y0, y1, x0, y0, torch.ones_like(x0)], 1)


def _cubic(basis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A basis F0, F1 of the null space and the cubic det(F0 + z F1), highest power first, in float64.

    The binary cubic p(a, b) = det(a F0 + b F1) is known from its values at (1, 0), (0, 1), (1, 1), (1, -1). It
    vanishes in at most three directions, so one of these four can be sent to infinity: the basis is turned and
    exchanged until the leading coefficient is the largest of the four, and no solution is lost at z = infinity.
    """
    f0, f1 = basis[0], basis[1]
    e0, e1 = f0.to(torch.float64), f1.to(torch.float64)
    half = 0.5**0.5
    directions = torch.stack([e0, e1, (e0 + e1) * half, (e0 - e1) * half], 1)
    p = determinant(directions.reshape(3, 3, *directions.shape[1:]))
    best = p.detach().abs().argmax(0)
    turned, exchanged = best >= 2, (best == 0) | (best == 2)
    plus, minus = (f0 + f1) * half, (f0 - f1) * half
    # (F0, F1) is (f0, f1), or after a turn by 45 degrees (plus, minus); then the one of larger determinant comes last.
    first, last = torch.where(turned, plus, f0), torch.where(turned, minus, f1)
    F0, F1 = torch.where(exchanged, last, first), torch.where(exchanged, first, last)
    q0, q1 = torch.where(turned, p[2], p[0]), torch.where(turned, p[3], p[1])
    # With a turn, (first + last) is f0 and (first - last) is f1, each times sqrt 2: the determinants need no new work.
    s, d = torch.where(turned, p[0], p[2]) * 2**1.5, torch.where(turned, p[1], p[3]) * 2**1.5
    d = torch.where(exchanged, -d, d)
    c0, c3 = torch.where(exchanged, q1, q0), torch.where(exchanged, q0, q1)
    c2, c1 = (s + d) / 2 - c0, (s - d) / 2 - c3
    return F0, F1, torch.stack([c3, c2, c1, c0])
