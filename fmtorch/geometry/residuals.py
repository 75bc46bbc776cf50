"""Sampson distances component by component, with derivatives for fits.

``r = e / g`` with ``e = x1^T F x0`` and ``g^2`` the squared norm of the first two entries of ``F x0`` and ``F^T x1``
together (Hartley & Zisserman 2004, equation 11.9). Element-wise, so that a distance has the same bits in any batch;
matrix products round differently with the shape of the batch. `geometry.sampson` is the same distance of matrices of
any scale in pixels.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

TINY = 1e-30  # squared slope of the epipolar constraint below which it is taken for this, in fits


def homogeneous(points: Float[Tensor, " 4 *s"]) -> Float[Tensor, " 2 3 *s"]:
    """x0, y0, x1, y1 as homogeneous points of the two images."""
    return torch.cat([points.reshape(2, 2, *points.shape[1:]), torch.ones_like(points[:2])[:, None]], 1)


def linearise(
    F: Float[Tensor, "9 p k"], points: Float[Tensor, "2 3 m p 1 lanes"], derivatives: bool = True
) -> tuple[Tensor, Float[Tensor, "m p k lanes"], Float[Tensor, "m p k lanes"], Float[Tensor, "m p k lanes"]]:
    """The Sampson residual ``r = e / g`` and its Jacobian: g J (3, 3, m, p, k, lanes), then e, 1 / g^2, and r^2.

    ``g dr = x1^T dF x0 - (e / g^2) ((F x0)^T D dF x0 + x1^T dF D F^T x1)`` with ``D = diag(1, 1, 0)``: the sum of two
    products of a column and a row. points: homogeneous. Without derivatives the first is empty.
    """
    x0, x1 = points
    rows = F.reshape(3, 3, 1, *F.shape[1:], 1)
    line1 = torch.addcmul(torch.addcmul(rows[:, 2], rows[:, 0], x0[0]), rows[:, 1], x0[1])  # F x0
    line0 = torch.addcmul(torch.addcmul(rows[2, :2], rows[0, :2], x1[0]), rows[1, :2], x1[1])  # F^T x1
    slope1 = line1[:2]
    e = torch.addcmul(torch.addcmul(line1[2], slope1[0], x1[0]), slope1[1], x1[1])
    a, b = torch.addcmul(slope1 * slope1, line0, line0)
    inverse = (a + b).clamp_min(TINY).reciprocal()
    c = e * inverse
    r2 = e * c
    if not derivatives:
        return e.new_empty(0), e, inverse, r2
    across1 = torch.cat([torch.addcmul(x1[:2], c, slope1, value=-1), torch.ones_like(e)[None]])  # x1 - c D F x0
    across0 = torch.cat([-c * line0, torch.zeros_like(e)[None]])  # -c D F^T x1
    return torch.addcmul(across1[:, None] * x0, x1[:, None], across0), e, inverse, r2
