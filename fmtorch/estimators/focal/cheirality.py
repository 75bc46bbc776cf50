"""Cheirality: matches that a calibrated model puts behind one of its cameras do not support it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.arithmetic import determinant, exact_sum, sqrt


def share_in_front(
    U: Float[Tensor, "3 3 p k"],
    V: Float[Tensor, "3 3 p k"],
    depth: Float[Tensor, "2 p k"],
    points: Float[Tensor, "4 p n"],
    support: Float[Tensor, "p k n"],
    tolerance: Float[Tensor, " p"],
) -> Float[Tensor, "p k"]:
    """Which share of the support lies in front of both cameras of ``E = U diag(1, 1, 0) V^T``.

    Of the four pairs of cameras (Hartley & Zisserman 2004, result 9.19) those with most support in front. A match whose
    two rays are parallel within the tolerance is far away, and in front of these cameras or of their opposites.
    U, V: orthogonal, rows first. depth: focal lengths, points: from the principal points, tolerance: all in the unit
    of points. support: what each match counts, in [0, 1]. NaN where nothing supports the model.

    In the axes of U and V let b be the ray in image 1 and a that in image 0. The rotations ``U W V^T`` and
    ``U W^T V^T`` turn a into ``r = (-+ a2, +- a1, d a3)``, d = det U det V, the translation is the third axis. The
    depths follow from ``z1 b = z0 r + t`` by products with ``b x r``: both have the sign of ``+- (a1 b2 - a2 b1)``
    relative to each other, and that of ``b3 |a1 b2 - a2 b1| - d a3 (b1^2 + b2^2)``.
    """
    x0, y0, x1, y1 = points[:, :, None]
    (a1, a2, a3), (b1, b2, b3) = (
        torch.addcmul(torch.addcmul(M[2, ..., None], (M[0] / f)[..., None], x), (M[1] / f)[..., None], y)
        for M, f, x, y in ((V, depth[0], x0, y0), (U, depth[1], x1, y1))
    )
    a, b = a1 * a1 + a2 * a2, b1 * b1 + b2 * b2
    handed = torch.where((determinant(U) > 0) == (determinant(V) > 0), 1.0, -1.0).to(a3)[..., None]
    side = a1 * b2 - a2 * b1
    distance = b3 * side.abs() - handed * a3 * b
    # |b x r| is |distance| / sqrt(b), and the sine of the angle between the rays that over |b| |r|.
    parallel = sqrt(b * (b + b3 * b3) * (a + a3 * a3)) * (tolerance[:, None] / depth[1])[..., None]
    ahead, behind = (torch.where(d > -parallel, support, 0) for d in (distance, -distance))
    fronts = torch.stack([exact_sum(torch.where(s > 0, x, 0)) for s in (side, -side) for x in (ahead, behind)])
    share: Tensor = fronts.amax(0) / exact_sum(support.clone())  # which is rounded in place
    return share
