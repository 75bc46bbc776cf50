"""Non-linear refinement of homographies: Levenberg-Marquardt of the robust Sampson error.

Minimises ``sum_i w_i rho(r_i^2)`` over the sphere of the nine entries, by kernels, and attaches the optimum to the
graph of points and weights. A model is refined to the same bits in any batch."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import component_sum, gradient_wanted, stable_sum
from fmtorch.geometry.epipolar import TINY
from fmtorch.geometry.levenberg_marquardt import MATCH, Schedule, Weighted, in_rows, minimiser, robust
from fmtorch.geometry.matrices import assign, assign_rows, unit_kernel
from fmtorch.geometry.normalize import NormalizedMatches, RobustSum, fitted_by
from fmtorch.geometry.rank2_manifold import damped_system, eliminate
from fmtorch.geometry.refine import inverse_hessian, jacobian
from fmtorch.jit.kernel import Array, F8x1, F8x2, F8x3, inner, kernel, matrix, vector
from fmtorch.jit.lanes import LANES, added, fill, load, store, where


class HomographyError(NamedTuple):
    """Of models and matches that broadcast to *s, by the terms of Hartley & Zisserman 2004, 4.2.6.
    squared: squared distances, infinite where undefined. front: whether the model's third coordinate at the match is
    positive. equations: e. inverse: the three entries of ``(J J^T)^-1``. corrected: x and y, their corrections added,
    and W times the multipliers l. multipliers: l."""

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


def homography_gradient(H: Float[Tensor, "9 p k"], error: RobustSum) -> Float[Tensor, "9 p k"]:
    """Half the gradient of the cost by the entries of H, ``G^T l``, attached to all inputs.
    Matches of weight zero and those behind the horizon count nothing, wherever they are."""
    at, (first, second), influence = _influence(H, error, error.rho.weight)
    l0, l1 = at.multipliers
    return stable_sum((first * l0 + second * l1) * influence)


def homography_curvature(H: Float[Tensor, "9 p k"], error: RobustSum) -> Float[Tensor, "p k 9 9"]:
    """The Gauss-Newton matrix ``G^T (J J^T)^-1 G`` with the curvature of the loss."""
    at, (first, second), influence = _influence(H, error, error.rho.curvature)
    i00, i01, i11 = at.inverse
    rows = torch.stack([first * i00 + second * i01, first * i01 + second * i11]) * influence
    return torch.einsum("eapkn,ebpkn->pkab", rows, torch.stack([first, second]))


def _influence(
    H: Tensor, error: RobustSum, slope: Callable[[Tensor, Tensor], Tensor]
) -> tuple[HomographyError, Tensor, Tensor]:
    """The errors of matches, G, and the weights times the slopes of the loss (p, k, n)."""
    counted = error.weight.detach() > 0
    matches = torch.where(counted, error.points, 0)[:, :, None]
    at = linearise_homography(H[..., None], matches)
    counted = counted[:, None] & at.front
    slopes = slope(torch.where(counted, at.squared, 0), error.s2[:, None])
    return at, equations_slope(at, matches), torch.where(counted, error.weight[:, None] * slopes, 0)


# The Sampson error of homographies, and its Levenberg-Marquardt on the sphere of their nine entries

BEHIND = 1e4  # squared distance of a match behind the horizon in the units of the points, which extend to about one
SUMS = 52  # over the matches, of the normal equations


class _State(NamedTuple):
    """Models of unit norm (k, 9), and the normal equations (k, 10, 10) and costs (k,) there."""

    H: Array
    products: Array
    cost: Array


@kernel
def evaluate_homographies(H: F8x2, weighted: Weighted, derivatives: bool, products: F8x3, cost: F8x1) -> None:
    """The robust error of models (k, 9) -> cost (k,); the normal equations -> products (k, 10, 10), if wanted.
    These are ``G^T (J J^T)^-1 G``, the gradient and r^2, each times the weights of matches and loss, summed."""
    rows, loss, table = in_rows(weighted.points, weighted.weight, weighted.s2), weighted.loss, weighted.table
    sums, factors, work = matrix(SUMS, LANES), matrix(14, LANES), matrix(3, LANES)
    for k in range(len(H)):
        costs = fill(0.0)
        for q in range(SUMS if derivatives else 0):
            store(sums, q, costs)
        for row in range(0, len(rows), MATCH):
            r2 = _linearise(H[k], rows, row, derivatives, factors)
            share, slope = robust(r2, load(rows, row + 5), loss, table, work)
            weight = load(rows, row + 4)
            costs += where(weight > 0.0, share * weight, 0.0)
            if derivatives:
                counted = where((weight > 0.0) & (r2 < BEHIND), weight * slope, 0.0)
                _add_products(factors, counted, sums)
                store(sums, SUMS - 1, load(sums, SUMS - 1) + counted * r2)
        cost[k] = added(costs)
        if derivatives:
            _assemble(sums, products[k])


@inner
def _linearise(h: Array, rows: Array, row: int, derivatives: bool, factors: Array) -> Any:
    """Squared distances of LANES matches; what their normal equations are made of -> factors (14, LANES), if wanted.
    G is (t, 0, c) and, in its second row, (0, t, d), in blocks of three entries: t, c, d, then the three entries of
    ``(J J^T)^-1`` and the two of l."""
    x, y, u, v = load(rows, row), load(rows, row + 1), load(rows, row + 2), load(rows, row + 3)
    w = h[6] * x + h[7] * y + h[8]
    e, f = h[0] * x + h[1] * y + h[2] - u * w, h[3] * x + h[4] * y + h[5] - v * w
    a, b, c, d = h[0] - u * h[6], h[1] - u * h[7], h[3] - v * h[6], h[4] - v * h[7]
    area, w2 = a * d - b * c, w * w
    determinant = area * area + w2 * (a * a + b * b + c * c + d * d + w2)
    inverse = 1.0 / where(determinant > TINY, determinant, TINY)
    i00, i01, i11 = (c * c + d * d + w2) * inverse, (a * c + b * d) * inverse, (a * a + b * b + w2) * inverse
    l0, l1 = i00 * e - i01 * f, i11 * f - i01 * e
    if derivatives:
        X, Y, du, dv = x - (a * l0 + c * l1), y - (b * l0 + d * l1), w * l0, w * l1
        store(factors, 0, (X, Y, fill(1.0)))
        store(factors, 3, (0.0 - (u * X + x * du), 0.0 - (u * Y + y * du), 0.0 - (u + du)))
        store(factors, 6, (0.0 - (v * X + x * dv), 0.0 - (v * Y + y * dv), 0.0 - (v + dv)))
        store(factors, 9, (i00, 0.0 - i01, i11, l0, l1))
    r2 = e * l0 + f * l1
    return where(w > 0.0, r2, where(w == w, BEHIND, r2))  # what is not a number stays none


@inner
def _add_products(factors: Array, counted: Any, sums: Array) -> None:
    """Adds the products of LANES matches, times what they count; factors: of `_linearise`.
    The blocks share their factors, so there are 52 sums in place of the 55 of each row of G: those of t t^T with the
    three entries of the inverse (6 each), of t with the rows of the last block (9 each), of that block (6), the
    gradient (9); the caller adds that of r^2."""
    p, q, s = load(factors, 9) * counted, load(factors, 10) * counted, load(factors, 11) * counted
    l0, l1 = load(factors, 12) * counted, load(factors, 13) * counted
    place = 0
    for r in range(3):
        t, c, d = load(factors, r), load(factors, 3 + r), load(factors, 6 + r)
        m, n = p * c + q * d, q * c + s * d
        for k in range(3):
            if k >= r:
                both = t * load(factors, k)
                store(sums, place, load(sums, place) + p * both)
                store(sums, 6 + place, load(sums, 6 + place) + q * both)
                store(sums, 12 + place, load(sums, 12 + place) + s * both)
                last = m * load(factors, 3 + k) + n * load(factors, 6 + k)
                store(sums, 36 + place, load(sums, 36 + place) + last)
                place += 1
            across = 18 + 3 * k + r
            store(sums, across, load(sums, across) + load(factors, k) * m)
            store(sums, across + 9, load(sums, across + 9) + load(factors, k) * n)
        store(sums, 42 + r, load(sums, 42 + r) + t * l0)
        store(sums, 45 + r, load(sums, 45 + r) + t * l1)
        store(sums, 48 + r, load(sums, 48 + r) + (c * l0 + d * l1))


@inner
def _assemble(sums: Array, products: Array) -> None:
    place = 0
    for r in range(3):
        for c in range(r, 3):
            p, q, s = added(load(sums, place)), added(load(sums, 6 + place)), added(load(sums, 12 + place))
            last = added(load(sums, 36 + place))
            products[r, c], products[c, r] = p, p
            products[r, 3 + c], products[c, 3 + r], products[3 + r, c], products[3 + c, r] = q, q, q, q
            products[3 + r, 3 + c], products[3 + c, 3 + r] = s, s
            products[6 + r, 6 + c], products[6 + c, 6 + r] = last, last
            place += 1
    for r in range(3):
        for c in range(3):
            m, n = added(load(sums, 18 + 3 * r + c)), added(load(sums, 27 + 3 * r + c))
            products[r, 6 + c], products[6 + c, r] = m, m
            products[3 + r, 6 + c], products[6 + c, 3 + r] = n, n
    for i in range(10):
        total = added(load(sums, 42 + i))
        products[i, 9], products[9, i] = total, total


@kernel
def refine_homographies(H: F8x2, matches: Weighted, schedule: Schedule, out: F8x2, cost: F8x1) -> None:
    """Models (k, 9) refined -> out (k, 9), of unit norm, cost (k,); what cannot be is not finite, nor its cost."""
    k = len(H)
    state = _State(out, np.empty((k, 10, 10)), cost)
    trial = _State(matrix(k, 9), np.empty((k, 10, 10)), vector(k))
    for i in range(k):
        assign(out[i], H[i])
        unit_kernel(out[i])
    _minimise(matches, state, trial, np.full(k, schedule.damping), schedule.iterations, schedule.tolerance)


@kernel(holds_gil=True)
def step_of_homography(H: F8x1, matches: Weighted, damping: float, out: F8x1) -> None:
    """One damped Gauss-Newton step of a model (9,) -> out (9,), of unit norm."""
    at, products, cost, Q = matrix(1, 9), np.empty((1, 10, 10)), vector(1), matrix(18, LANES)
    assign(at[0], H)
    unit_kernel(at[0])
    evaluate_homographies(at, matches, True, products, cost)
    _stepped(products[0], at[0], damping, Q, out)


@inner
def _evaluate(state: _State, matches: Weighted, derivatives: bool) -> None:
    evaluate_homographies(state.H, matches, derivatives, state.products, state.cost)


@inner
def _step(matches: Weighted, state: _State, damping: Array, trial: _State) -> None:
    Q = matrix(18, LANES)
    for k in range(len(damping)):
        _stepped(state.products[k], state.H[k], damping[k], Q, trial.H[k])


@inner
def _stepped(products: Array, h: Array, damping: float, Q: Array, out: Array) -> None:
    damped_system(products, h, damping, Q)
    for r in range(9):
        Q[2 * r + 1, 9 - LANES] = -products[r, 9]
    eliminate(Q, 9)
    for i in range(9):
        out[i] = h[i] + Q[2 * i + 1, 9 - LANES]
    unit_kernel(out)


@inner
def _take(state: _State, trial: _State, k: int) -> None:
    assign(state.H[k], trial.H[k])
    assign_rows(state.products[k], trial.products[k])


_minimise = minimiser(_evaluate, _step, _take)


def refine_homography(
    H: Float[Tensor, "*models 3 3"], x0: Float[Tensor, "*batch n 2"], x1: Float[Tensor, "*batch n 2"],
    weight: Float[Tensor, "*batch n"] | None = None, mask: Bool[Tensor, "*batch n"] | None = None,
    *, loss: str = "truncated", scale: float | Tensor = 1.0, iterations: int = 10,
) -> Float[Tensor, "*models 3 3"]:  # fmt: skip
    """The homography of least robust Sampson error near H: ``sum_i w_i rho(r_i^2)``.

    Hartley & Zisserman (2004), 4.5 and 4.2.6. Differentiable in points and weights by the implicit function theorem
    with the exact Hessian; there is no gradient to H. Gradients are bounded where the matches leave H open, and zero
    for a model that cannot be refined. The values are the same whether or not anything requires gradients; they are
    computed on the CPU.

    Args:
        H: one matrix for each set of matches, or K of them, (*batch, K, 3, 3), of any scale and sign.
        x0, x1, weight, mask, loss, scale, iterations: as of `refine`.

    Returns:
        Matrices of unit norm in float64, whose third coordinate of H x0 is positive at most of the weight; one that
        cannot be refined comes back as it was, scaled.

    Raises:
        ValueError: for an unknown loss.

    Example:
        >>> import torch
        >>> from fmtorch.geometry import homography_points, refine_homography
        >>> H = torch.tensor([[1.0, 0.1, 5.0], [0.0, 0.9, 3.0], [1e-4, 0.0, 1.0]], dtype=torch.float64)
        >>> x0 = torch.rand(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 500
        >>> refined = refine_homography(torch.eye(3), x0, homography_points(H, x0), scale=500.0)
        >>> bool(((refined / refined[2, 2] - H).abs() < 1e-6).all())
        True
    """
    wanted = gradient_wanted(x0, x1, weight)
    with torch.set_grad_enabled(wanted):
        matches = NormalizedMatches(x0, x1, weight, mask, H.detach(), scale, loss, homographies=True)
        models, _ = fitted_by(refine_homographies, _seen_from_the_front(matches), matches.error, iterations)
        if wanted:
            models = homography_at_optimum(models, matches.error)
        return matches.to_pixels(models).reshape(H.shape)


def homography_at_optimum(H: Float[Tensor, "9 p k"], error: RobustSum) -> Float[Tensor, "9 p k"]:
    """H, optima of unit norm on no graph, attached to the graph of points and weights by the implicit function theorem.
    As `refine.at_optimum`: the optimum moves by minus the inverse Hessian across H times the change of the gradient."""
    valid, fixed = torch.isfinite(H).all(0) & (H != 0).any(0), error.detached()
    model = torch.where(valid, H, torch.eye(3, dtype=H.dtype, device=H.device).reshape(9, 1, 1) / 3**0.5)
    exact = jacobian(functools.partial(homography_gradient, error=fixed), model)
    gauss_newton = homography_curvature(model, fixed)
    inverse = inverse_hessian((exact + exact.mT) / 2, gauss_newton, model.movedim(0, -1)[..., None])
    gradient = homography_gradient(model, error)
    moved = component_sum(inverse * (gradient - gradient.detach()), 1)
    return H - torch.where(valid, moved, 0)


def _seen_from_the_front(matches: NormalizedMatches) -> Float[Tensor, "9 p k"]:
    """The models with a sign that makes the third coordinate positive at most of the matches' weight."""
    H, weight = matches.models.detach(), matches.weight.detach()[:, None]
    x, y, _, _ = matches.points.detach()[:, :, None]
    depth = H[6, ..., None] * x + H[7, ..., None] * y + H[8, ..., None]
    side = stable_sum(torch.where(depth > 0, weight, -weight))
    return torch.where(side < 0, -H, H)
