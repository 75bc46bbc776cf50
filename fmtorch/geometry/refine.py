"""Non-linear refinement of fundamental matrices: Levenberg-Marquardt of the robust Sampson error.

Minimises ``sum_i w_i rho(r_i^2)``, r the Sampson distance, over the 7-dimensional manifold of 3 x 3 matrices of rank 2
and unit norm (see `rank2_manifold`), by kernels, and attaches the optimum to the graph of points and weights. A model
is refined to the same bits in any batch.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry import rank2_manifold
from fmtorch.geometry.arithmetic import as_rows, cofactors, component_sum, gradient_wanted, sqrt, stable_sum, unit
from fmtorch.geometry.epipolar import linearise
from fmtorch.geometry.levenberg_marquardt import Schedule, Weighted, evaluate, minimiser
from fmtorch.geometry.matrices import assign, assign_rows
from fmtorch.geometry.normalize import NormalizedMatches, RobustSum, fitted_by
from fmtorch.geometry.rank2_manifold import RANK_TWO, RANK_TWO_EPIPOLE, constant, start_one, steps
from fmtorch.jit.kernel import Array, F8x1, F8x2, inner, kernel, matrix, vector


class _State(NamedTuple):
    """Models of rank 2 (k, 9), their epipoles (k, 3), and the normal equations (k, 10, 10) and costs (k,) there."""

    F: Array
    e0: Array
    e1: Array
    products: Array
    cost: Array


@kernel
def refine_kernel(F: F8x2, matches: Weighted, schedule: Schedule, out: F8x2, cost: F8x1) -> None:
    """Models (k, 9) made rank 2 and refined -> out (k, 9), cost (k,); what cannot be is not finite, nor its cost.
    The cost of a model never rises above that of its start."""
    k = len(F)
    state = _State(out, matrix(k, 3), matrix(k, 3), np.empty((k, 10, 10)), cost)
    trial = _State(matrix(k, 9), matrix(k, 3), matrix(k, 3), np.empty((k, 10, 10)), vector(k))
    for i in range(k):
        start_one(F[i], schedule.squarings, state.F[i], state.e0[i], state.e1[i])
    _minimise(matches, state, trial, np.full(k, schedule.damping), schedule.iterations, schedule.tolerance)


@inner
def _evaluate(state: _State, matches: Weighted, derivatives: bool) -> None:
    evaluate(state.F, matches, derivatives, state.products, state.cost)


@inner
def _step(matches: Weighted, state: _State, damping: Array, trial: _State) -> None:
    steps(state.products, state.F, state.e0, state.e1, damping, trial.F, trial.e0, trial.e1)


@inner
def _take(state: _State, trial: _State, k: int) -> None:
    assign(state.F[k], trial.F[k])
    assign(state.e0[k], trial.e0[k])
    assign(state.e1[k], trial.e1[k])
    assign_rows(state.products[k], trial.products[k])


_minimise = minimiser(_evaluate, _step, _take)


def refine(
    F: Float[Tensor, "*models 3 3"],
    x0: Float[Tensor, "*batch n 2"],
    x1: Float[Tensor, "*batch n 2"],
    weight: Float[Tensor, "*batch n"] | None = None,
    mask: Bool[Tensor, "*batch n"] | None = None,
    *,
    loss: str = "truncated",
    scale: float | Tensor = 1.0,
    iterations: int = 10,
) -> Float[Tensor, "*models 3 3"]:
    """The fundamental matrix of least robust Sampson error near F: ``sum_i w_i rho(r_i^2)``.

    Bartoli & Sturm (2004); Hartley & Zisserman (2004), 11.4.3. Differentiable in points and weights, not in F: by the
    implicit function theorem with the exact Hessian, the gradient is that of the optimum. (`attached_step` takes Gauss
    and Newton's Hessian: its gradient is off by 0.2 to 5 % at a noise of 1 px with a focal length of 1000 px, by 6 to
    65 % at 10 px, and by 1 to 50 % where a robust loss weighs wrong matches.) Gradients are bounded where the matches
    leave F open, and zero for a model that cannot be refined. Where nothing requires them no graph is built, and the
    values are the same in any case.

    Args:
        F: one matrix for each set of matches, or K of them, (*batch, K, 3, 3).
        x0: points of image 0, pixels.
        x1: their matches in image 1.
        weight: not negative, 1 by default.
        mask: False in slots to ignore, whatever they hold; a match that is not finite is ignored too.
        loss: a name of `robust_losses.LOSSES`.
        scale: of the loss, in pixels (a number, or one per set).
        iterations: Levenberg-Marquardt steps.

    Returns:
        Matrices of rank 2 and unit norm in float64; one that cannot be refined comes back as it was, scaled.

    Raises:
        ValueError: for an unknown loss.
    """
    wanted = gradient_wanted(x0, x1, weight)
    with torch.set_grad_enabled(wanted):
        matches = NormalizedMatches(x0, x1, weight, mask, F.detach(), scale, loss)
        models, _ = fitted_by(refine_kernel, matches.models, matches.error, iterations)
        if wanted:
            models = at_optimum(models, matches.error)
        return matches.to_pixels(models).reshape(F.shape)


def attached_step(
    F: Float[Tensor, "*models 3 3"],
    x0: Float[Tensor, "*batch n 2"],
    x1: Float[Tensor, "*batch n 2"],
    weight: Float[Tensor, "*batch n"] | None = None,
    mask: Bool[Tensor, "*batch n"] | None = None,
    *,
    loss: str = "truncated",
    scale: float | Tensor = 1.0,
) -> Float[Tensor, "*models 3 3"]:
    """One Gauss-Newton step from a refined F, whose gradients are those of the optimum.

    The gradient of the cost is attached to the graph of points and weights, the normal matrix is not. This is the
    implicit function theorem with the Hessian in the Gauss-Newton approximation, which has the curvature of the loss
    but not that of the residuals: it is exact where the residuals that count vanish.

    Args:
        F: the optimum, as `refine` returns it; it gets no gradient.
        x0, x1, weight, mask, loss, scale: those with which `refine` found it.

    Returns:
        F after the step. Where the points leave a direction undetermined, the step and its gradients in that direction
        are damped; where F or the step is not finite, F comes back with gradients of zero.

    Raises:
        ValueError: there is no such loss.
    """
    matches = NormalizedMatches(x0, x1, weight, mask, F.detach(), scale, loss)
    with torch.no_grad():
        model, e0, e1 = rank2_manifold.start(matches.models)
        H = curvature_of_cost(model, matches.error)
        identity = torch.eye(9, dtype=H.dtype, device=H.device)[:, :, None, None].expand_as(H)
        inverse = rank2_manifold.constrained_solve(H, model, e0, e1, torch.full_like(H[0, 0], STEP_DAMPING), identity)
        valid = torch.isfinite(inverse).flatten(0, 1).all(0)
        inverse = torch.where(valid, inverse, 0)
        # Something of rank 2 instead of what is not finite: `where` alone would not keep NaN out of the gradients.
        model = torch.where(valid, model, constant(model, RANK_TWO))
        e0, e1 = (torch.where(valid, e, constant(e, RANK_TWO_EPIPOLE)) for e in (e0, e1))
    step = -component_sum((inverse * gradient_of_cost(model, matches.error)).transpose(0, 1))
    moved, _, _ = rank2_manifold.retract(model, step, e0, e1)
    return matches.to_pixels(torch.where(valid, moved, matches.models)).reshape(F.shape)


# Gradients of the least robust Sampson error: those of the optimum

STEP_DAMPING = 1e-10  # of a Gauss-Newton step at an optimum: bounds it where the points leave a direction open


def gradient_of_cost(F: Float[Tensor, "9 p k"], error: RobustSum) -> Float[Tensor, "9 p k"]:
    """Half the gradient of the cost with respect to F, ``sum_i w_i rho'(r_i^2) r_i dr_i``; attached to all inputs."""
    J, e, inverse, r2 = linearise(F, error.points)
    influence = error.weight[:, None] * error.rho.weight(r2, error.s2[:, None]) * inverse * e
    return stable_sum(J.flatten(0, 1) * influence)


def curvature_of_cost(F: Float[Tensor, "9 p k"], error: RobustSum) -> Float[Tensor, "9 9 p k"]:
    """The Gauss-Newton matrix ``J^T W J`` with Newton's weights, those of the loss's curvature, not those of IRLS."""
    J, _, inverse, r2 = linearise(F, error.points)
    J = J.flatten(0, 1)
    weighted = J * (error.weight[:, None] * error.rho.curvature(r2, error.s2[:, None]) * inverse)
    return torch.stack([stable_sum(weighted * column) for column in J], 1)


def at_optimum(F: Float[Tensor, "9 p k"], error: RobustSum) -> Float[Tensor, "9 p k"]:
    """F, optima of rank 2 and unit norm, attached to the graph of points and weights by the implicit function theorem.
    The optimum moves by ``dF = -H^-1 d(gradient)`` in the tangent space of the manifold. H is the Hessian of the cost
    on it, exact: with the curvature of the residuals, and with that of the constraint ``det F = 0`` by its Lagrange
    multiplier: of ``cost + 2 multiplier det F``. Where it is not positive definite, at what is no strict minimum, Gauss
    and Newton's takes its place. Directions that the points leave open are damped; what is not finite or zero has a
    gradient of zero. F on no graph. Returns the same values."""
    fixed = error.detached()
    with torch.no_grad():
        valid = torch.isfinite(F).all(0) & (F != 0).any(0)
        model = unit(torch.where(valid, F, constant(F, RANK_TWO)))
        C = cofactors(as_rows(model)).flatten(0, 1)
        size = component_sum(C * C)
        valid = valid & (size > 0)
        size = torch.where(size > 0, size, 1)
        normal = C / sqrt(size)
        gauss_newton = curvature_of_cost(model, fixed).movedim((0, 1), (-2, -1))
        frame = torch.stack([model, normal], -1).movedim(0, -2)

    def lagrangian_slope(model: Tensor) -> Tensor:
        gradient = gradient_of_cost(model, fixed)
        multiplier = -component_sum(gradient.detach() * C) / size
        return gradient + multiplier * cofactors(as_rows(model)).flatten(0, 1)

    H = jacobian(lagrangian_slope, model)
    inverse = inverse_hessian((H + H.mT) / 2, gauss_newton, frame)
    gradient = gradient_of_cost(model, error)
    moved = component_sum(inverse * (gradient - gradient.detach()), 1)
    return F - torch.where(valid, moved, 0)  # keeps the gradient of what is not finite out


def jacobian(function: Callable[[Tensor], Tensor], at: Float[Tensor, "9 p k"]) -> Float[Tensor, "p k 9 9"]:
    """The derivatives of a function of models, of each for itself, by their entries."""
    with torch.enable_grad():
        models = at.detach().clone().requires_grad_()
        values = function(models)
        rows = [torch.autograd.grad(values[i].sum(), models, retain_graph=True)[0] for i in range(9)]
    return torch.stack(rows).movedim((0, 1), (-2, -1))


@torch.no_grad()
def inverse_hessian(
    exact: Float[Tensor, "p k 9 9"], gauss_newton: Float[Tensor, "p k 9 9"], frame: Float[Tensor, "p k 9 normals"]
) -> Float[Tensor, "9 9 p k"]:
    """The inverse of the exact Hessian across the orthonormal normals of a manifold, 0 along these.
    Where it is not finite or not positive definite, at what is no strict minimum, Gauss and Newton's takes its place.
    Directions that the points leave open are damped."""
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
