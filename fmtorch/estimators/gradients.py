"""Gradients of estimates to points, prior and noise: the only tensors behind the door of an estimator.

The value of an estimate is computed without a graph; a zero that has its gradients is added to it. So the estimate has
the same bits whether anybody asks for gradients or not, and gradients are those of the fit, not of the search."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate
from fmtorch.estimators.lens_search import half_diagonals
from fmtorch.estimators.models import posterior
from fmtorch.estimators.models.fundamental import Matrices, response_of
from fmtorch.estimators.pair import MAX_NOISE, MIN_NOISE, Pair
from fmtorch.estimators.refinement import Fit, NoFit
from fmtorch.geometry import canonical, eight_point, unit_frobenius
from fmtorch.geometry.arithmetic import component_sum, sqrt, weighted_sum
from fmtorch.geometry.cameras import PixelFrame
from fmtorch.geometry.epipolar import mean_stretch
from fmtorch.geometry.homography_refine import homography_at_optimum
from fmtorch.geometry.normalize import RobustSum
from fmtorch.geometry.refine import STEP_DAMPING, gradient_of_cost
from fmtorch.jit.kernel import Array
from fmtorch.jit.lanes import LANES


class Solved(NamedTuple):
    """A pair, where its matches stand in the caller's tensors (n,), and its fit."""

    pair: Pair
    slot: Array
    fit: Fit


class GraphedMatches(NamedTuple):
    """The usable matches of P pairs in normalised units, attached to the caller's graph, padded to N slots; float64.
    precision: one over the square of the noise. weight: the prior times that."""

    points: Float[Tensor, "4 p n"]
    mask: Bool[Tensor, "p n"]
    precision: Float[Tensor, "p n"]
    weight: Float[Tensor, "p n"]
    prior: Float[Tensor, "p n"] | None

    @property
    def points0(self) -> Float[Tensor, "p n 2"]:
        """Points of image 0."""
        return self.points[:2].permute(1, 2, 0)

    @property
    def points1(self) -> Float[Tensor, "p n 2"]:
        """Points of image 1."""
        return self.points[2:].permute(1, 2, 0)


Attach = Callable[[list[Solved], GraphedMatches], Float[Tensor, "p m"]]
"""A zero with the gradients of fits, models (9) of normalised points; perhaps of the logarithms of two focal lengths
and of two lenses, too."""


class Attached:
    """The gradients of a final fit, by its `gradient`; of homographies by the Sampson error, near least squares."""

    def __init__(self, final: NoFit, family: Matrices) -> None:
        self.final, self.family = final, family

    def __call__(self, solved: list[Solved], matches: GraphedMatches) -> Float[Tensor, "p m"]:
        if self.final.gradient == "none":
            return matches.points.new_zeros(len(solved), 9)
        linear = self.final.gradient == "least_squares" and self.family.model == "fundamental"
        return self._least_squares(solved, matches) if linear else self._optimum(solved, matches)

    @property
    def reached(self) -> tuple[str, ...]:
        """The fields of `Correspondences` that gradients reach."""
        if self.final.gradient == "none":
            return ()
        if self.final.gradient == "least_squares" and not self.final.weighted:
            return ("x0", "x1")
        return ("x0", "x1", "noise", *(("prior",) if self.family.fit_scale.by_prior else ()))

    def _least_squares(self, solved: list[Solved], matches: GraphedMatches) -> Float[Tensor, "p 9"]:
        counted = _padded([s.fit.counted for s in solved], matches.mask)
        weighted = self.final.weighted and matches.prior is not None
        weight = torch.where(counted > 0, matches.weight, 0) if weighted else counted
        fitted, valid = eight_point(matches.points0, matches.points1, weight)
        fitted = torch.where(valid[:, None, None], fitted, 0).flatten(1)
        return fitted - fitted.detach()

    def _optimum(self, solved: list[Solved], matches: GraphedMatches) -> Float[Tensor, "p m"]:
        """By the implicit function theorem: the optimum moves with the gradient of its cost."""
        device = matches.mask.device
        at = torch.from_numpy(np.stack([s.fit.at for s in solved])).to(device)
        counted = _padded([s.fit.counted for s in solved], matches.mask)
        weight = matches.weight if self.family.fit_scale.by_prior else matches.precision
        weight = torch.where(counted > 0, counted * weight, 0)
        if self.family.model == "homography":
            return _homographies_at_optimum(solved, at, matches, weight)
        error = RobustSum(matches.points, weight, "truncated", torch.full_like(at[:, :1], torch.inf))
        gradient = gradient_of_cost(at.T[..., None], error)[..., 0].T
        response = torch.from_numpy(np.stack([_response(s) for s in solved])).to(device)
        zero = _zero_with(response, gradient)
        if bent := [i for i, s in enumerate(solved) if s.fit.lens is not None]:
            own = _bent_at_optimum([solved[i] for i in bent], matches.points[:, bent], weight[bent])
            zero = torch.nn.functional.pad(zero, (0, 2)).index_add(0, torch.tensor(bent, device=device), own)
        return zero


def _homographies_at_optimum(
    solved: list[Solved], at: Float[Tensor, "p 9"], matches: GraphedMatches, weight: Float[Tensor, "p n"]
) -> Float[Tensor, "p 9"]:
    """Zeros with the gradients of homographies, by the loss of their fits."""
    loss, s2 = "truncated", torch.full_like(at[:, :1], torch.inf)
    scales = [s.fit.s2 for s in solved if s.fit.s2 is not None]  # of all fits, or of none
    if scales:
        loss, s2 = "cauchy", torch.where(matches.mask, _padded(scales, matches.mask), 1)
    model = torch.nn.functional.normalize(at, dim=1).T[..., None]
    attached = homography_at_optimum(model, RobustSum(matches.points, weight, loss, s2))[..., 0].T
    return attached - attached.detach()


def _bent_at_optimum(
    solved: list[Solved], points: Float[Tensor, "4 p n"], weight: Float[Tensor, "p n"]
) -> Float[Tensor, "p 13"]:
    """Zeros with the gradients of fits of bent photographs, whose cost is that of `lens_search`."""
    known = zip(*(lens_response(s.fit, s.pair) for s in solved), strict=True)
    at, offset, response = (torch.from_numpy(np.stack(each)).to(weight.device) for each in known)
    points = points + offset.T[..., None]
    a0, a1 = points[:2], points[2:]
    F, bend0, bend1 = at[:, :9].T.reshape(3, 3, -1, 1), at[:, 9:10], at[:, 10:]
    h0, h1 = (torch.cat([a, 1 + bend * component_sum(a * a)[None]]) for a, bend in ((a0, bend0), (a1, bend1)))
    line1, line0 = component_sum(F * h0[None], 1), component_sum(F * h1[:, None], 0)
    slope0, slope1 = line0[:2] + 2 * bend0 * a0 * line0[2], line1[:2] + 2 * bend1 * a1 * line1[2]
    square = component_sum(slope0 * slope0) + component_sum(slope1 * slope1)
    c = component_sum(h1 * line1) / torch.where(square > 0, square, 1)
    along0, along1 = component_sum(a0 * slope0), component_sum(a1 * slope1)
    d0, d1 = (torch.cat([s, 2 * b * t[None]]) for s, b, t in ((slope0, bend0, along0), (slope1, bend1, along1)))
    by_entry = (h1 - c * d1)[:, None] * h0[None] - h1[:, None] * (c * d0)[None]
    by_bend = [
        component_sum(a * a) * (line[2] - c * component_sum(d * column)) - 2 * c * line[2] * along
        for a, line, d, column, along in ((a0, line0, d1, F[:, 2], along0), (a1, line1, d0, F[2], along1))
    ]
    gradient = weighted_sum([*by_entry.flatten(0, 1), *by_bend], weight * c).T
    return _zero_with(response, gradient)


def _zero_with(response: Float[Tensor, "p k m"], gradient: Float[Tensor, "p m"]) -> Float[Tensor, "p k"]:
    """A zero that moves with the gradients of costs; summed one after the other, in any batch and both ways."""
    change = gradient - gradient.detach()
    return torch.stack([component_sum(row * change, -1) for row in response.unbind(1)], 1)


def _response(solved: Solved) -> Array:
    """How the fit of a pair, and the logarithms of its focal lengths, move with the gradient of its cost, (11, 9)."""
    pair, fit = solved.pair, solved.fit
    if fit.lens is not None:
        return np.zeros((11, 9))
    weight = fit.counted * pair.weight
    if fit.cameras is not None:
        return camera_response(fit.cameras, pair, weight, fit.precision)
    return np.concatenate([response_of(fit.at, pair, weight), np.zeros((2, 9))])


def with_gradients(estimate: Estimate, c: Correspondences, solved: dict[int, Solved], attach: Attach) -> Estimate:
    """The estimate of a batch with the gradients of the pairs that are solved, zero of others; the same values."""
    if not solved:
        return estimate.derived(matrix=estimate.matrix + _nothing(c).to(estimate.matrix))
    rows = torch.tensor(list(solved), device=c.mask.device)
    zero = attach(list(solved.values()), graphed_matches(c, solved))
    F = torch.from_numpy(np.stack([s.fit.F for s in solved.values()])).to(zero)
    homographies = estimate.model == "homography"
    models = _frame(solved, zero).to_pixels((F + zero[:, :9]).reshape(-1, 1, 3, 3), homographies)[:, 0]
    G = unit_frobenius(models) if homographies else canonical(models)
    attached = {"matrix": estimate.matrix.index_add(0, rows, G - G.detach())}
    if estimate.focals is not None and zero.shape[1] > 9:
        attached["focals"] = estimate.focals.index_add(0, rows, estimate.focals.detach()[rows] * zero[:, 9:11])
    if estimate.lens is not None and zero.shape[1] > 11:
        attached["lens"] = estimate.lens.index_add(0, rows, zero[:, 11:].to(estimate.lens))
    return estimate.derived(**attached)


def graphed_matches(c: Correspondences, solved: dict[int, Solved]) -> GraphedMatches:
    """The usable matches of the pairs that are solved."""
    rows, pairs = torch.tensor(list(solved), device=c.mask.device), [s.pair for s in solved.values()]
    n = max(pair.count for pair in pairs)
    slot = np.zeros((len(pairs), n), np.int64)
    for place, each in zip(slot, solved.values(), strict=True):
        place[: len(each.slot)] = each.slot
    count, index = torch.tensor([pair.count for pair in pairs]), torch.from_numpy(slot).to(rows)
    mask = (torch.arange(n) < count[:, None]).to(rows.device)

    def take(value: Tensor | None) -> Tensor | None:
        return None if value is None else torch.where(mask, value[rows].gather(1, index), 0).to(torch.float64)

    pixels = torch.cat([c.x0, c.x1], -1)[rows].to(torch.float64).gather(1, index[..., None].expand(-1, -1, 4))
    points = torch.where(mask[..., None], _frame(solved, pixels).normalized(pixels), 0).permute(2, 0, 1)
    prior, noise = take(c.prior), take(c.noise)
    precision = mask.to(torch.float64)
    if noise is not None:
        stretch = [pair.stretch for pair in pairs if pair.stretch is not None]
        if c.stretch is not None and stretch:
            noise = noise / torch.where(mask, mean_stretch(c.stretch[rows], sqrt).gather(1, index), 1)
            precision = precision / torch.where(mask, _padded(stretch, mask), 1).square()
        precision = precision / torch.where(mask, noise.nan_to_num(1).clamp(MIN_NOISE, MAX_NOISE), 1).square()
    weight = precision if prior is None else precision * prior.nan_to_num(0).clamp(0, 1)
    return GraphedMatches(points, mask, precision, weight, prior)


def _frame(solved: dict[int, Solved], like: Tensor) -> PixelFrame:
    pairs = [each.pair for each in solved.values()]
    centre = torch.from_numpy(np.stack([pair.centre for pair in pairs])).to(like)
    return PixelFrame(centre, torch.tensor([pair.pixels_per_unit for pair in pairs]).to(like))


def camera_response(cameras: posterior.Cameras, pair: Pair, weight: Array, precision: float) -> Array:
    """How the optimum of the posterior moves with the gradient of its cost by the nine entries, (11, 9): its model and
    the logarithms of its focal lengths.

    weight: (n,), of the matches that count. precision: one over the variance of an inlier's distance."""
    images, optimum, tangents = posterior.images_of(pair), posterior.start_at(cameras.copy()), np.zeros((1, 9, LANES))
    matches = posterior.centred(pair)._replace(weight=weight, s2=np.full(pair.count, np.inf))
    posterior.minimise(optimum, matches, images, posterior.Limits(precision, 0, 0.0))
    posterior.tangents_of(cameras, images.longest, optimum.F, tangents)
    moves, by_focal = np.empty((7, 9)), np.eye(7, 2, -5)
    posterior.translate(np.ascontiguousarray(tangents[0, :, :7].T), images.offset, moves)
    if images.prior.shared:  # one parameter for both
        moves[5], moves[6], by_focal[5], by_focal[6] = moves[5] + moves[6], 0, 1, 0
    return _moved(optimum.hessian[0], moves, np.concatenate([moves, by_focal], 1), precision)


def _moved(hessian: Array, by_cost: Array, by_estimate: Array, precision: float) -> Array:
    """How an estimate (k,) moves with the gradient (m,) of a cost, (k, m), by its parameters' derivatives of both."""
    try:
        steps = np.linalg.solve(hessian + STEP_DAMPING * np.diag(np.diag(hessian)), by_cost)
    except np.linalg.LinAlgError:
        return np.zeros((by_estimate.shape[1], by_cost.shape[1]))
    response: Array = -precision * by_estimate.T @ steps
    return response if np.isfinite(response).all() else np.zeros_like(response)


def lens_response(fit: Fit, pair: Pair) -> tuple[Array, Array, Array]:
    """Of a fit of bent photographs, its model and bends (11,) for points from the principal points, the offset (4,) of
    these, and how model, logarithms of focal lengths and lenses move with the gradient by the former, (13, 11)."""
    assert fit.lens is not None
    assert pair.lens is not None
    images, area, lens = posterior.images_of(pair), half_diagonals(pair) ** -2.0, fit.lens
    F, tangents, by_cost, by_estimate = np.empty((2, 9)), np.zeros((1, 9, LANES)), np.zeros((9, 11)), np.eye(9, 13, 4)
    posterior.tangents_of(lens.cameras, images.longest, F[:1], tangents)
    by_cost[:7, :9], by_cost[7, 9], by_cost[8, 10] = tangents[0, :, :7].T, *area
    posterior.translate(F[:1], images.offset, F[1:])
    moves = np.empty((7, 9))
    posterior.translate(np.ascontiguousarray(by_cost[:7, :9]), images.offset, moves)
    by_estimate[:7, :9] = moves / math.sqrt((F[1] * F[1]).sum())
    for first, shared in ((5, images.prior.shared), (7, pair.lens.shared)):
        for moved in (by_cost, by_estimate) if shared else ():
            moved[first], moved[first + 1] = moved[first] + moved[first + 1], 0
    at = np.concatenate([F[0], lens.lens * area])
    return at, images.offset, _moved(lens.hessian, by_cost, by_estimate, fit.precision)


def _nothing(c: Correspondences) -> Tensor:
    """Zero, with a gradient of zero to all that has one."""
    attached = [t for t in (c.x0, c.x1, c.prior, c.noise) if t is not None and t.requires_grad]
    return torch.stack([t[:0].sum().to(torch.float64) for t in attached]).sum() if attached else torch.zeros(())


def _padded(rows: list[Array], mask: Bool[Tensor, "p n"]) -> Float[Tensor, "p n"]:
    """Numbers of the matches of each pair, zero in padded slots."""
    out = np.zeros(tuple(mask.shape))
    for place, row in zip(out, rows, strict=True):
        place[: len(row)] = row
    return torch.from_numpy(out).to(mask.device)
