"""Iteratively reweighted least squares for fundamental matrices, differentiable, with weights of any origin."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry import normalize
from fmtorch.geometry.arithmetic import component_sum, gradient_wanted, unit
from fmtorch.geometry.eight_point import linear_fundamental, weighted_eight_point
from fmtorch.geometry.epipolar import linearise, sampson
from fmtorch.geometry.levenberg_marquardt import MATCH, Weighted, in_rows, linearise_kernel, robust
from fmtorch.geometry.matrices import assign, nearest_rank2
from fmtorch.geometry.normalize import NormalizedMatches, RobustSum, canonical, normalize_points
from fmtorch.geometry.rank2_manifold import RANK_TWO, constant
from fmtorch.geometry.refine import jacobian
from fmtorch.jit.kernel import F8x2, kernel, matrix, vector
from fmtorch.jit.lanes import LANES, load, store

CONTRACTION_GAP = 1e-6  # singular values of I - J below it, of an iteration that does not contract, are held off zero

Weigh = Callable[[Tensor | None, Tensor | None], Tensor]


def irls(
    x0: Float[Tensor, "*batch n 2"],
    x1: Float[Tensor, "*batch n 2"],
    F0: Float[Tensor, "*models 3 3"],
    weight: Float[Tensor, "*batch n"] | None = None,
    mask: Bool[Tensor, "*batch n"] | None = None,
    *,
    loss: str = "cauchy",
    scale: float | Tensor = 1.0,
    iterations: int = 5,
) -> Float[Tensor, "*models 3 3"]:
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
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    weigh: Weigh,
    iterations: int,
    mask: Bool[Tensor, "b n"] | None = None,
    F0: Float[Tensor, "b 3 3"] | None = None,
) -> Fits:
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
        F = torch.where(determined[..., None], canonical(pixels), first if F is None else F)
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
    x0, T0 = normalize_points(points[..., :2], weight=w)
    x1, T1 = normalize_points(points[..., 2:], weight=w)
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
    """`irls.reweighted` of models (k, 9), in place."""
    matches = in_rows(weighted.points, weighted.weight, weighted.s2)
    J, work = matrix(10, LANES), matrix(3, LANES)
    weights, fitted = matrix(len(matches) // MATCH, LANES), vector(9)
    for k in range(len(F)):
        for row in range(0, len(matches), MATCH):
            inverse, r2 = linearise_kernel(F[k], matches, row, J)
            _, slope = robust(r2, load(matches, row + 5), weighted.loss, weighted.table, work)
            store(weights, row // MATCH, inverse * (load(matches, row + 4) * slope))
        if weighted_eight_point(weighted.points, weights.ravel()[: len(weighted.weight)], fitted):
            assign(F[k], fitted)
