"""Non-linear fits of fundamental matrices: Levenberg-Marquardt of the robust Sampson error, and reweighting (`irls`).

Minimises ``sum_i w_i rho(r_i^2)``, r the Sampson distance, over the 7-dimensional manifold of 3 x 3 matrices of rank 2
and unit norm (see `rank2_manifold`), by kernels, and attaches the optimum to the graph of points and weights. A model
is refined to the same bits in any batch."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry import arithmetic, levenberg_marquardt, normalize, rank2_manifold
from fmtorch.geometry.arithmetic import as_rows, cofactors, component_sum, gradient_wanted, sqrt, stable_sum, unit
from fmtorch.geometry.eight_point import linear_fundamental, weighted_eight_point
from fmtorch.geometry.epipolar import linearise, sampson
from fmtorch.geometry.levenberg_marquardt import MATCH, Schedule, Weighted, evaluate, minimiser
from fmtorch.geometry.matrices import assign, assign_rows, nearest_rank2
from fmtorch.geometry.normalize import NormalizedMatches, RobustSum, fitted_by
from fmtorch.geometry.rank2_manifold import RANK_TWO, RANK_TWO_EPIPOLE, constant, start_one, steps
from fmtorch.jit.kernel import Array, F8x1, F8x2, inner, kernel, matrix, vector
from fmtorch.jit.lanes import LANES, load, store


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
    F: Float[Tensor, "*models 3 3"], x0: Float[Tensor, "*batch n 2"], x1: Float[Tensor, "*batch n 2"],
    weight: Float[Tensor, "*batch n"] | None = None, mask: Bool[Tensor, "*batch n"] | None = None,
    *, loss: str = "truncated", scale: float | Tensor = 1.0, iterations: int = 10,
) -> Float[Tensor, "*models 3 3"]:  # fmt: skip
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
        loss: a name of `geometry.LOSSES`.
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
    F: Float[Tensor, "*models 3 3"], x0: Float[Tensor, "*batch n 2"], x1: Float[Tensor, "*batch n 2"],
    weight: Float[Tensor, "*batch n"] | None = None, mask: Bool[Tensor, "*batch n"] | None = None,
    *, loss: str = "truncated", scale: float | Tensor = 1.0,
) -> Float[Tensor, "*models 3 3"]:  # fmt: skip
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
    return arithmetic.weighted_sum([*J.flatten(0, 1)], influence)


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


# Iteratively reweighted least squares, differentiable, with weights of any origin

CONTRACTION_GAP = 1e-6  # singular values of I - J below it, of an iteration that does not contract, are held off zero

Weigh = Callable[[Tensor | None, Tensor | None], Tensor]


def irls(
    x0: Float[Tensor, "*batch n 2"], x1: Float[Tensor, "*batch n 2"], F0: Float[Tensor, "*models 3 3"],
    weight: Float[Tensor, "*batch n"] | None = None, mask: Bool[Tensor, "*batch n"] | None = None,
    *, loss: str = "cauchy", scale: float | Tensor = 1.0, iterations: int = 5,
) -> Float[Tensor, "*models 3 3"]:  # fmt: skip
    """Fundamental matrices near F0 by the normalised 8-point algorithm with Sampson weights, repeated.

    Each iteration weighs the squared algebraic error ``e^2`` of a match by ``w rho'(r^2) / g^2``, where ``r = e / g``
    is the Sampson distance under the last F: Torr & Murray (1997), "The development and comparison of robust methods
    for estimating the fundamental matrix", section 4. A fixed point is close to, but not quite, the least of
    ``sum w rho(r^2)``, since g moves with F: `refine` finds that.

    Differentiable in points and weights, not in F0: by the implicit function theorem, the gradient is that of the fixed
    point F = fit(F, points, weights) (see `at_fixed_point`). It costs ten iterations and needs the memory of two. Each
    iteration divides the distance from the fixed point by 1.2 to 30; before it the gradient is near that there: after 5
    iterations with the Cauchy loss and 20 wrong matches among 120 it is off by 0.1 %. Gradients are bounded where the
    matches leave F open, and zero for a model that is kept as it was. Where nothing requires them no graph is built,
    and the values are the same in any case.

    Args:
        F0: one matrix for each set of matches, or K of them, (*batch, K, 3, 3).
        x0, x1, weight, mask, loss, scale: as of `refine`.
        iterations: reweighted fits.

    Returns:
        Matrices of rank 2 and unit norm in float64; a model that the weighted matches do not determine is kept as it
        was.

    Raises:
        ValueError: for an unknown loss.
    """
    wanted = gradient_wanted(x0, x1, weight, scale)
    with torch.set_grad_enabled(wanted):
        matches = NormalizedMatches(x0, x1, weight, mask, F0, scale, loss)
        step = functools.partial(reweighted, error=matches.error)
        F = matches.models.detach()
        with torch.no_grad():
            for _ in range(iterations):
                F = step(F)
        if wanted:
            F = at_fixed_point(F, step)
        return matches.to_pixels(F).reshape(F0.shape)


class Fits(NamedTuple):
    """The fits of all iterations: matrices in pixels, of rank 2 and unit norm, and which of them were determined."""

    F: Float[Tensor, "iterations b 3 3"]
    valid: Bool[Tensor, "iterations b"]


def reweighted_fits(
    x0: Float[Tensor, "b n 2"], x1: Float[Tensor, "b n 2"], weigh: Weigh, iterations: int,
    mask: Bool[Tensor, "b n"] | None = None, F0: Float[Tensor, "b 3 3"] | None = None,
) -> Fits:  # fmt: skip
    """Iterated weighted 8-point fits whose weights any function predicts from the last fit and its residuals.

    The iteration of Ranftl & Koltun, Deep fundamental matrix estimation, ECCV 2018, section 3.2, where `weigh` is a
    network, and that of `irls`, where it is ``w rho'(r^2) / g^2``. Differentiable in the points, the weights and, so,
    in what `weigh` is made of, unrolled through all iterations; gradients as of `irls`.

    Args:
        x0: points of image 0, pixels.
        x1: their matches in image 1.
        weigh: maps the last fit (B, 3, 3), in pixels, and the matches' Sampson distances under it (B, N), in pixels, to
            weights (B, N), not negative, of any scale. Both are None in the first iteration without F0. The distances
            are zero in slots that do not count; so they are, and F is zero, where no fit was determined so far. Weights
            in masked slots are ignored.
        iterations: fits.
        mask: False in slots to ignore; matches that are not finite are ignored too.
        F0: the fit that the first weights are predicted from, of unit norm.

    Returns:
        The fits in float64. One that its weights do not determine, as when fewer than eight matches count or a weight
        is negative or not finite, is not valid and repeats the last one that was, or zero.

    Raises:
        ValueError: iterations below 1.
    """
    if iterations < 1:
        raise ValueError(f"iterations is {iterations}; it must be at least 1")
    first = torch.zeros(len(x0), 3, 3, dtype=torch.float64, device=x0.device) if F0 is None else F0.to(torch.float64)
    matches = NormalizedMatches(x0, x1, None, mask, first)
    clean0, clean1 = (torch.where(matches.counts[..., None], x, 0).to(torch.float64) for x in (x0, x1))

    def distances(F: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b n"]:
        return torch.where(matches.counts, sampson(F, clean0, clean1), 0)

    F, residual = (None, None) if F0 is None else (first, distances(first))
    fits, valid = [], []
    for _ in range(iterations):
        fitted, determined = weighted_fit(matches.points, matches.ordered(weigh(F, residual))[:, None])
        # Of rank 2 instead of what is not determined: `where` alone would not keep NaN out of the gradients.
        pixels = matches.to_pixels(torch.where(determined, fitted, constant(fitted, RANK_TWO)))[:, 0]
        F = torch.where(determined[..., None], normalize.canonical(pixels), first if F is None else F)
        residual = distances(F)
        fits.append(F)
        valid.append(determined[:, 0])
    return Fits(torch.stack(fits), torch.stack(valid))


def reweighted(F: Float[Tensor, "9 p k"], error: RobustSum) -> Float[Tensor, "9 p k"]:
    """One iteration, component by component: the 8-point algorithm with the weights that the residuals under F give.
    F: k models for each of p pairs, entries row by row. Models of rank 2; what matches leave open stays as it was."""
    finite = torch.isfinite(F).all(0)
    _, _, inverse, r2 = linearise(torch.where(finite, F, constant(F, RANK_TWO)), error.points, derivatives=False)
    w = error.weight[:, None] * (error.rho.weight(r2, error.s2[:, None]) * inverse)
    fitted, determined = weighted_fit(error.points, w)
    return torch.where(finite & determined, fitted, F)


def weighted_fit(
    points: Float[Tensor, "4 p n"], weight: Float[Tensor, "p k n"]
) -> tuple[Float[Tensor, "9 p k"], Bool[Tensor, "p k"]]:
    """The normalised 8-point algorithm with k sets of weights for each of p pairs, and which of them determine a model.
    points: as of `reweighted`. Models of rank 2, of any scale; what is not determined means nothing but is finite."""
    p, k = weight.shape[:2]
    valid = (torch.isfinite(weight) & (weight >= 0)).all(-1, keepdim=True) & (weight > 0).any(-1, keepdim=True)
    scales = torch.where(valid, weight.detach(), 1)  # changes no fit
    largest = scales.amax(-1, keepdim=True) if scales.shape[-1] else torch.ones_like(valid, dtype=scales.dtype)
    w = torch.where(valid, weight, 0) / largest
    points = points[:, :, None].expand(4, p, k, -1).movedim(0, -1)
    x0, T0 = normalize.normalize_points(points[..., :2], weight=w)
    x1, T1 = normalize.normalize_points(points[..., 2:], weight=w)
    linear, determined = linear_fundamental(x0, x1, w)
    fitted = normalize.denormalize_fundamental(nearest_rank2(linear), T0, T1).flatten(2).movedim(-1, 0)
    determined = determined & valid[..., 0] & torch.isfinite(fitted).all(0) & (fitted != 0).any(0)
    return fitted, determined


def at_fixed_point(F: Float[Tensor, "9 p k"], step: Callable[[Tensor], Tensor]) -> Float[Tensor, "9 p k"]:
    """F, a fixed point of `step` up to scale and sign, attached to the graph of everything else that `step` reads.
    With G(F, theta) the step, scaled to unit norm, and J its Jacobian with respect to F, the fixed point moves by
    ``dF = (I - J)^-1 dG/dtheta dtheta`` (Bai et al., NeurIPS 2019, theorem 1). G maps to the manifold of rank 2 and
    unit norm, so J and dG map to its 7-dimensional tangent space, and dF lies in it. Where the iteration does not
    contract, singular values s of I - J are inverted as ``s / (s^2 + CONTRACTION_GAP^2)``, which bounds the gradient.
    F: on no graph; of rank 2. One that is zero or not finite has a gradient of zero, and so has one that `step`, one
    iteration of all models, each for itself, leaves as it is. Returns the same values."""
    valid = torch.isfinite(F).all(0) & (F != 0).any(0)
    fixed = unit(torch.where(valid, F, constant(F, RANK_TWO)))

    def mapped(start: Tensor) -> Tensor:
        G = unit(step(start))
        along = component_sum(G.detach() * fixed)
        return torch.where(along < 0, -G, G)

    J = jacobian(mapped, fixed)
    with torch.enable_grad():
        attached = mapped(fixed)
    known = valid & torch.isfinite(J).flatten(-2).all(-1)
    difference = torch.eye(9, dtype=J.dtype, device=J.device) - torch.where(known[..., None, None], J, 0.0)
    U, s, Vh = torch.linalg.svd(difference)
    inverse = (Vh.mT * (s / (s * s + CONTRACTION_GAP**2))[..., None, :]) @ U.mT
    inverse = torch.where(known[..., None, None], inverse, 0.0).movedim((-2, -1), (0, 1))
    size = torch.where(valid, component_sum(F * fixed), 0.0)
    moved = component_sum(inverse * (attached - attached.detach()), 1) * size
    return F + torch.where(valid, moved, 0.0)  # keeps the gradient of what is not finite out


@kernel
def reweighted_kernel(F: F8x2, weighted: Weighted) -> None:
    """`reweighted` of models (k, 9), in place."""
    matches = levenberg_marquardt.in_rows(weighted.points, weighted.weight, weighted.s2)
    J, work = matrix(10, LANES), matrix(3, LANES)
    weights, fitted = matrix(len(matches) // MATCH, LANES), vector(9)
    for k in range(len(F)):
        for row in range(0, len(matches), MATCH):
            inverse, r2 = levenberg_marquardt.linearise_kernel(F[k], matches, row, J, 0)
            _, slope = levenberg_marquardt.robust(r2, load(matches, row + 5), weighted.loss, weighted.table, work)
            store(weights, row // MATCH, inverse * (load(matches, row + 4) * slope))
        if weighted_eight_point(weighted.points, weights.ravel()[: len(weighted.weight)], fitted):
            assign(F[k], fitted)
