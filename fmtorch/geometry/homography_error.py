"""The Sampson error of homographies in tensors, and its gradient with a graph to points and weights."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def homography_sampson_squared(H: Float[Tensor, "p 9"], points: Float[Tensor, "4 p n"]) -> Float[Tensor, "p n"]:
    """Squared distances of matches x0, y0, x1, y1; see `homography_objective_kernels`. Infinite behind the horizon."""
    x, y, u, v = points
    h = H.T[..., None]
    w = h[6] * x + h[7] * y + h[8]
    front = w > 0
    w = torch.where(front, w, 1)
    e, f = h[0] * x + h[1] * y + h[2] - u * w, h[3] * x + h[4] * y + h[5] - v * w
    a, b, c, d = h[0] - u * h[6], h[1] - u * h[7], h[3] - v * h[6], h[4] - v * h[7]
    p, q, area, w2 = c * e - a * f, d * e - b * f, a * d - b * c, w * w
    determinant = area * area + w2 * (a * a + b * b + c * c + d * d + w2)
    return torch.where(front, (w2 * (e * e + f * f) + p * p + q * q) / determinant, torch.inf)


def homography_gradient(
    H: Float[Tensor, "p 9"], points: Float[Tensor, "4 p n"], weight: Float[Tensor, "p n"]
) -> Float[Tensor, "p 9"]:
    """Half the gradient of ``sum_i w_i r_i^2`` by the entries of H, attached to points and weights.

    Matches of weight zero count nothing, wherever they are.
    """
    counted = weight.detach() > 0
    with torch.enable_grad():
        model = H.detach().clone().requires_grad_()
        squared = homography_sampson_squared(model, torch.where(counted, points, 0))
        cost = torch.where(counted, weight * torch.where(counted, squared, 0), 0).sum() / 2
        (gradient,) = torch.autograd.grad(cost, model, create_graph=True)
    return gradient
