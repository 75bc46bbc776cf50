"""Gradients of the least robust Sampson error: those of the optimum."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.arithmetic import as_rows, cofactors, component_sum, sqrt, stable_sum, unit
from fmtorch.geometry.epipolar import homogeneous, linearise
from fmtorch.geometry.rank2_manifold import RANK_TWO, constant
from fmtorch.geometry.robust_losses import RobustLoss

STEP_DAMPING = 1e-10  # of the attached step: bounds its gradient where the points leave a direction open


def gradient_of_cost(
    F: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    robust: RobustLoss,
    scale: Float[Tensor, " p"],
) -> Float[Tensor, "9 p k"]:
    """Half the gradient of the cost with respect to F, ``sum_i w_i rho'(r_i^2) r_i dr_i``; attached to all inputs."""
    J, e, inverse, r2 = linearise(F, homogeneous(points[:, None, :, None]))
    influence = weight[:, None] * robust.weight(r2, scale.square()[:, None, None]) * inverse * e
    return stable_sum(J.flatten(0, 1) * influence)[:, 0]


def curvature_of_cost(
    F: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    robust: RobustLoss,
    scale: Float[Tensor, " p"],
) -> Float[Tensor, "9 9 p k"]:
    """The Gauss-Newton matrix ``J^T W J`` with Newton's weights, those of the loss's curvature, not those of IRLS."""
    J, _, inverse, r2 = linearise(F, homogeneous(points[:, None, :, None]))
    J = J.flatten(0, 1)[:, 0]
    weighted = J * (weight[:, None] * robust.curvature(r2, scale.square()[:, None, None]) * inverse)[0]
    return torch.stack([stable_sum(weighted * column) for column in J], 1)


def at_optimum(
    F: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    robust: RobustLoss,
    scale: Float[Tensor, " p"],
) -> Float[Tensor, "9 p k"]:
    """F, optima of rank 2 and unit norm, attached to the graph of points and weights by the implicit function theorem.

    The optimum moves by ``dF = -H^-1 d(gradient)`` in the tangent space of the manifold. H is the Hessian of the cost
    on it, exact: with the curvature of the residuals, and with that of the constraint ``det F = 0`` by its Lagrange
    multiplier. Where it is not positive definite, at what is no strict minimum, Gauss and Newton's takes its place.
    Directions that the points leave open are damped; what is not finite or zero has a gradient of zero.

    Arguments as of `gradient_of_cost`; F on no graph. Returns the same values.
    """
    with torch.no_grad():
        valid = torch.isfinite(F).all(0) & (F != 0).any(0)
        model = unit(torch.where(valid, F, constant(F, RANK_TWO)))
        C = cofactors(as_rows(model)).flatten(0, 1)
        size = component_sum(C * C)
        valid = valid & (size > 0)
        normal = C / sqrt(torch.where(size > 0, size, 1))
        gauss_newton = curvature_of_cost(model, points, weight, robust, scale).movedim((0, 1), (-2, -1))
        frame = torch.stack([model, normal], -1).movedim(0, -2)
    exact = _hessian(model, C, size, points.detach(), weight.detach(), robust, scale.detach())
    inverse = inverse_hessian(exact, gauss_newton, frame)
    gradient = gradient_of_cost(model, points, weight, robust, scale)
    moved = component_sum(inverse * (gradient - gradient.detach()), 1)
    return F - torch.where(valid, moved, 0)  # keeps the gradient of what is not finite out


@torch.no_grad()
def inverse_hessian(
    exact: Float[Tensor, "p k 9 9"], gauss_newton: Float[Tensor, "p k 9 9"], frame: Float[Tensor, "p k 9 normals"]
) -> Float[Tensor, "9 9 p k"]:
    """The inverse of the exact Hessian across the orthonormal normals of a manifold, 0 along these.

    Where it is not finite or not positive definite, at what is no strict minimum, Gauss and Newton's takes its place.
    Directions that the points leave open are damped.
    """
    across = torch.eye(9, dtype=exact.dtype, device=exact.device) - frame @ frame.mT
    largest = gauss_newton.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None]
    blocked = largest * (frame @ frame.mT)  # so that these directions do not look open
    finite = torch.isfinite(exact).flatten(-2).all(-1)[..., None, None]
    tangent = across @ torch.where(finite, exact, gauss_newton) @ across + blocked
    strict = finite[..., 0, 0] & (torch.linalg.eigvalsh(tangent)[..., 0] > STEP_DAMPING * largest[..., 0, 0])
    tangent = torch.where(strict[..., None, None], tangent, across @ gauss_newton @ across + blocked)
    values, vectors = torch.linalg.eigh(tangent)
    open_below = STEP_DAMPING * torch.where(largest > 0, largest, 1)[..., 0]
    inverse = (vectors * (values / (values * values + open_below * open_below))[..., None, :]) @ vectors.mT
    projected: Tensor = across @ inverse @ across
    return projected.movedim((-2, -1), (0, 1))


def _hessian(
    F: Tensor, C: Tensor, size: Tensor, points: Tensor, weight: Tensor, robust: RobustLoss, scale: Tensor
) -> Float[Tensor, "p k 9 9"]:
    """Half the second derivative of the Lagrangian ``cost + 2 multiplier det F``; C are F's cofactors, size |C|^2."""
    with torch.enable_grad():
        model = F.detach().clone().requires_grad_()
        gradient = gradient_of_cost(model, points, weight, robust, scale)
        multiplier = -component_sum(gradient.detach() * C) / torch.where(size > 0, size, 1)
        total = gradient + multiplier * cofactors(as_rows(model)).flatten(0, 1)
        rows = [torch.autograd.grad(total[i].sum(), model, retain_graph=True)[0] for i in range(9)]
    H = torch.stack(rows).movedim((0, 1), (-2, -1))
    return (H + H.mT) / 2


# Gradients of the fixed point of an iteration over fundamental matrices, by the implicit function theorem

CONTRACTION_GAP = 1e-6  # singular values of I - J below it, of an iteration that does not contract, are held off zero


def gradient_wanted(*inputs: object) -> bool:
    """Whether a graph is being recorded and one of the inputs is on it."""
    return torch.is_grad_enabled() and any(isinstance(x, Tensor) and x.requires_grad for x in inputs)


def at_fixed_point(F: Float[Tensor, "9 p k"], step: Callable[[Tensor], Tensor]) -> Float[Tensor, "9 p k"]:
    """F, a fixed point of `step` up to scale and sign, attached to the graph of everything else that `step` reads.

    With G(F, theta) the step, scaled to unit norm, and J its Jacobian with respect to F, the fixed point moves by
    ``dF = (I - J)^-1 dG/dtheta dtheta`` (Bai et al., NeurIPS 2019, theorem 1). G maps to the manifold of rank 2 and
    unit norm, so J and dG map to its 7-dimensional tangent space, and dF lies in it. Where the iteration does not
    contract, singular values s of I - J are inverted as ``s / (s^2 + CONTRACTION_GAP^2)``, which bounds the gradient.

    Args:
        F: k models for each of p pairs, entries row by row, on no graph; of rank 2. One that is zero or not finite has
            a gradient of zero.
        step: one iteration of all models, each for itself; a model that it leaves as it is has a gradient of zero.

    Returns:
        The same values.
    """
    valid = torch.isfinite(F).all(0) & (F != 0).any(0)
    fixed = unit(torch.where(valid, F, constant(F, RANK_TWO)))

    def mapped(start: Tensor) -> Tensor:
        G = unit(step(start))
        along = component_sum(G.detach() * fixed)
        return torch.where(along < 0, -G, G)

    with torch.enable_grad():
        start = fixed.detach().clone().requires_grad_()
        end = mapped(start)
        rows = [torch.autograd.grad(end[i].sum(), start, retain_graph=True)[0] for i in range(9)]
        attached = mapped(fixed)
    J = torch.stack(rows).movedim((0, 1), (-2, -1))
    known = valid & torch.isfinite(J).flatten(-2).all(-1)
    difference = torch.eye(9, dtype=J.dtype, device=J.device) - torch.where(known[..., None, None], J, 0.0)
    U, s, Vh = torch.linalg.svd(difference)
    inverse = (Vh.mT * (s / (s * s + CONTRACTION_GAP**2))[..., None, :]) @ U.mT
    inverse = torch.where(known[..., None, None], inverse, 0.0).movedim((-2, -1), (0, 1))
    size = torch.where(valid, component_sum(F * fixed), 0.0)
    moved = component_sum(inverse * (attached - attached.detach()), 1) * size
    return F + torch.where(valid, moved, 0.0)  # keeps the gradient of what is not finite out
