"""The Sampson error of homographies in tensors, and its gradient with a graph to points and weights."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.optimum import STEP_DAMPING


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
    H: Float[Tensor, "p 9"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    s2: Float[Tensor, "p n"] | None = None,
) -> tuple[Float[Tensor, "p 9"], Float[Tensor, "p 9 9"]]:
    """Half the gradient of ``sum_i w_i rho(r_i^2)`` by the entries of H, attached to points and weights.

    And how the optimum on the sphere of nine entries moves with that gradient, by the second derivatives there, without
    gradient. rho is Cauchy's, ``s^2 log(1 + r^2 / s^2)``; without s2 the squared error. Matches of weight zero count
    nothing, wherever they are, nor do those behind the horizon.
    """
    with torch.enable_grad():
        model = H.detach().clone().requires_grad_()
        squared = homography_sampson_squared(model, torch.where(weight.detach() > 0, points, 0))
        counted = (weight.detach() > 0) & torch.isfinite(squared.detach())
        squared = torch.where(counted, squared, 0)
        s2 = None if s2 is None else torch.where(counted, s2, 1)
        loss = squared if s2 is None else s2 * torch.log1p(squared / s2)
        cost = torch.where(counted, weight * loss, 0).sum() / 2
        (gradient,) = torch.autograd.grad(cost, model, create_graph=True)
        rows = [torch.autograd.grad(gradient[:, i].sum(), model, retain_graph=True)[0] for i in range(9)]
    at = torch.nn.functional.normalize(model.detach(), dim=1)
    radial = at[:, :, None] * at[:, None, :]
    curvature = torch.stack(rows, 1)
    largest = curvature.diagonal(dim1=1, dim2=2).amax(1)[:, None, None]
    tangent = torch.eye(9).to(at) - radial
    solved, failed = torch.linalg.solve_ex(curvature + largest * (radial + STEP_DAMPING * torch.eye(9).to(at)), tangent)
    valid = (failed == 0) & torch.isfinite(solved).flatten(1).all(1)
    return gradient, torch.where(valid[:, None, None], -solved, 0)
