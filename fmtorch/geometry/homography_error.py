"""The Sampson error of homographies in tensors, and its gradient with a graph to points and weights."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import stable_sum
from fmtorch.geometry.robust_losses import Kernel


class HomographyError(NamedTuple):
    """Of models and matches that broadcast to *s; see `homography_objective_kernels`.

    squared: squared distances, infinite where undefined. front: whether the model's third coordinate at the match is
    positive. equations: e. inverse: the three entries of ``(J J^T)^-1``. corrected: x and y, their corrections added,
    and W times the multipliers l. multipliers: l.
    """

    squared: Float[Tensor, "*s"]
    front: Bool[Tensor, "*s"]
    inverse: tuple[Tensor, Tensor, Tensor]
    multipliers: tuple[Tensor, Tensor]
    corrected: tuple[Tensor, Tensor, Tensor, Tensor]


def linearise_homography(h: Float[Tensor, " 9 *m"], points: Float[Tensor, " 4 *p"]) -> HomographyError:
    """The error of matches x0, y0, x1, y1 under models of nine entries, row by row; the two broadcast."""
    x, y, u, v = points
    w = h[6] * x + h[7] * y + h[8]
    e, f = h[0] * x + h[1] * y + h[2] - u * w, h[3] * x + h[4] * y + h[5] - v * w
    a, b, c, d = h[0] - u * h[6], h[1] - u * h[7], h[3] - v * h[6], h[4] - v * h[7]
    area, w2 = a * d - b * c, w * w
    determinant = area * area + w2 * (a * a + b * b + c * c + d * d + w2)
    defined = determinant > 0
    by = 1 / torch.where(defined, determinant, 1)
    i00, i01, i11 = (c * c + d * d + w2) * by, -(a * c + b * d) * by, (a * a + b * b + w2) * by
    l0, l1 = i00 * e + i01 * f, i01 * e + i11 * f
    p, q = c * e - a * f, d * e - b * f
    squared = torch.where(defined, (w2 * (e * e + f * f) + p * p + q * q) * by, torch.inf)
    corrected = (x - (a * l0 + c * l1), y - (b * l0 + d * l1), w * l0, w * l1)
    return HomographyError(squared, defined & (w > 0), (i00, i01, i11), (l0, l1), corrected)


def equations_slope(error: HomographyError, points: Float[Tensor, " 4 *p"]) -> Float[Tensor, " 2 9 *s"]:
    """G, the derivative of the two corrected equations of each match by the nine entries."""
    X, Y, du, dv = error.corrected
    x, y, u, v = (p.expand_as(X) for p in points)
    ones, zero = torch.ones_like(X), torch.zeros_like(X)
    first = [X, Y, ones, zero, zero, zero, -(u * X + x * du), -(u * Y + y * du), -(u + du)]
    second = [zero, zero, zero, X, Y, ones, -(v * X + x * dv), -(v * Y + y * dv), -(v + dv)]
    return torch.stack([torch.stack(first), torch.stack(second)])


def homography_gradient(
    H: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    robust: Kernel,
    s2: Float[Tensor, "p slots"],
) -> Float[Tensor, "9 p k"]:
    """Half the gradient of ``sum_i w_i rho(r_i^2)`` by the entries of H, ``G^T l``, attached to all inputs.

    s2: squared scales of the loss, one a pair or a match. Matches of weight zero and those behind the horizon count
    nothing, wherever they are.
    """
    counted = weight.detach() > 0
    matches = torch.where(counted, points, 0)[:, :, None]
    error = linearise_homography(H[..., None], matches)
    counted = counted[:, None] & error.front
    slope = robust.weight(torch.where(counted, error.squared, 0), s2[:, None])
    influence = torch.where(counted, weight[:, None] * slope, 0)
    first, second = equations_slope(error, matches)
    l0, l1 = error.multipliers
    return stable_sum((first * l0 + second * l1) * influence)


def homography_curvature(
    H: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    robust: Kernel,
    s2: Float[Tensor, "p slots"],
) -> Float[Tensor, "p k 9 9"]:
    """The Gauss-Newton matrix ``G^T (J J^T)^-1 G`` with the curvature of the loss; arguments as of the gradient."""
    counted = weight > 0
    matches = torch.where(counted, points, 0)[:, :, None]
    error = linearise_homography(H[..., None], matches)
    counted = counted[:, None] & error.front
    slope = robust.curvature(torch.where(counted, error.squared, 0), s2[:, None])
    influence = torch.where(counted, weight[:, None] * slope, 0)
    first, second = equations_slope(error, matches)
    i00, i01, i11 = error.inverse
    rows = torch.stack([first * i00 + second * i01, first * i01 + second * i11]) * influence
    return torch.einsum("eapkn,ebpkn->pkab", rows, torch.stack([first, second]))
