"""Normalisation of image points before linear estimation, and of fundamental matrices after it."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import as_components, as_matrices, component_sum, matmul3, sqrt, stable_sum, unit
from fmtorch.geometry.cameras import PixelFrame
from fmtorch.geometry.epipolar import Matrix, unit_frobenius
from fmtorch.geometry.levenberg_marquardt import LOSSES, RobustLoss, Schedule, Weighted, named_loss

Points = Float[Tensor, "*batch n 2"]
PerMatch = Float[Tensor, "*batch n"]
Mask = Bool[Tensor, "*batch n"]
Matrices = Float[Tensor, "*batch 3 3"]


def normalize_points(x: Points, mask: Mask | None = None, weight: PerMatch | None = None) -> tuple[Points, Matrices]:
    """Points moved to zero mean and mean distance sqrt(2), and the similarity T that does it (x_n = T x).

    Hartley, In Defense of the Eight-Point Algorithm, PAMI 1997. Means are over the points in `mask`, weighted by
    `weight`. Masked slots come out zero. Coincident points (or none) are centred and keep their scale.

    Args:
        x: points (..., N, 2).
        mask: (..., N), True for the points that count; all by default.
        weight: (..., N), at least 0; 1 by default.

    Returns:
        The points moved (..., N, 2), and T (..., 3, 3).
    """
    w = torch.ones_like(x[..., 0]) if weight is None else weight
    if mask is not None:
        x, w = torch.where(mask[..., None], x, 0.0), torch.where(mask, w, 0.0)
    centroid = _mean(x, w)
    centred = x - centroid[..., None, :]
    scale = _scale(_mean_distance(centred, w), centroid)
    scaled = centred * scale[..., None, None]
    scaled = scaled if mask is None else torch.where(mask[..., None], scaled, 0.0)
    return scaled, _similarity(centroid, scale)


def denormalize_fundamental(F: Matrix, T0: Matrix, T1: Matrix) -> Matrix:
    """The fundamental matrix T1^T F T0 of points x, given F of the normalised points T x; leading shapes broadcast.

    Args:
        F: of normalised points, (..., 3, 3).
        T0: the similarity (..., 3, 3) that normalised the points of image 0.
        T1: that of image 1.

    Returns:
        (..., 3, 3), not scaled.
    """
    return matmul3(matmul3(T1.mT, F), T0)


def canonical(F: Matrices) -> Matrices:
    """F scaled to unit Frobenius norm with its entry of largest magnitude (the first of equals) positive.
    A zero matrix stays zero, with zero gradient."""
    flat = F.detach().reshape(*F.shape[:-2], 9)
    peak = torch.gather(flat, -1, flat.abs().argmax(-1, keepdim=True))[..., None]
    return unit_frobenius(F) * torch.copysign(torch.ones_like(peak), peak)


def _mean(x: Tensor, w: Tensor) -> Tensor:
    total = stable_sum(w, -1)
    return stable_sum(w[..., None] * x, -2) / torch.where(total > 0, total, 1.0)[..., None]


def _mean_distance(centred: Tensor, w: Tensor) -> Tensor:
    """The mean distance to the origin; a point at the origin has gradient zero."""
    d2 = component_sum(centred * centred, -1)
    away = d2 > 0
    distance = torch.where(away, sqrt(torch.where(away, d2, 1.0)), 0.0)
    total = stable_sum(w, -1)
    return stable_sum(w * distance, -1) / torch.where(total > 0, total, 1.0)


def _scale(distance: Tensor, centroid: Tensor) -> Tensor:
    """sqrt(2) / distance; 1 where the distance is no more than the rounding error of the centroid."""
    rounding = 4 * torch.finfo(distance.dtype).eps * centroid.detach().abs().amax(-1)
    spread = distance > rounding
    return torch.where(spread, 2**0.5 / torch.where(spread, distance, 1.0), 1.0)


def _similarity(centroid: Tensor, scale: Tensor) -> Tensor:
    zero, ones = torch.zeros_like(scale), torch.ones_like(scale)
    tx, ty = (-scale[..., None] * centroid).unbind(-1)
    return torch.stack([scale, zero, tx, zero, scale, ty, zero, zero, ones], -1).reshape(*scale.shape, 3, 3)


# The way into the solvers: leading shapes flattened, masked slots moved to the end, coordinates normalised


class RobustSum(NamedTuple):
    """``sum_i w_i rho(r_i^2)`` over the matches of P pairs.
    points: x0, y0, x1, y1, of about unit scale; finite. weight: 0 in padded slots. loss: the name of rho. s2: squared
    scales of the loss, in the unit of the points, one a pair or a match."""

    points: Float[Tensor, "4 p n"]
    weight: Float[Tensor, "p n"]
    loss: str
    s2: Float[Tensor, "p slots"]

    @property
    def rho(self) -> RobustLoss:
        """The loss with its derivatives."""
        return LOSSES[self.loss]

    def detached(self) -> "RobustSum":
        """The same on no graph."""
        return RobustSum(self.points.detach(), self.weight.detach(), self.loss, self.s2.detach())


class NormalizedMatches:
    """Matches of P pairs, those that count first, centred, of about unit scale, and K models for each pair.
    points: (4, P, N), rows x0, y0, x1, y1, zero in padded slots. weight: (P, N), likewise. error: the robust sum of
    both. models: (9, P, K), entries row by row, of about unit scale. counts: which of the caller's matches count.
    Everything is float64 and attached to the caller's graph; the frame is constant. scale: of the loss, px.
    homographies: the models F are homographies, not fundamental matrices. Raises ValueError for an unknown loss."""

    def __init__(
        self, x0: Tensor, x1: Tensor, weight: Tensor | None, mask: Tensor | None, F: Tensor,
        scale: float | Tensor = 1.0, loss: str = "truncated", homographies: bool = False,
    ) -> None:  # fmt: skip
        named_loss(loss)
        p, n = math.prod(x0.shape[:-2]), x0.shape[-2]
        x = torch.cat([x0, x1], -1).to(torch.float64).reshape(p, n, 4)
        w = torch.ones_like(x[..., 0]) if weight is None else weight.to(torch.float64).reshape(p, n)
        finite = torch.isfinite(x).all(-1) & torch.isfinite(w)
        mask = finite if mask is None else finite & mask.reshape(p, n)
        self.counts = mask.reshape(x0.shape[:-1])
        self._order = order = torch.argsort((~mask).to(torch.uint8), dim=1, stable=True)
        self._mask = mask = mask.gather(1, order)
        inside = mask[..., None]
        x = torch.where(inside, x.gather(1, order[..., None].expand(-1, -1, 4)), 0)
        self.weight = self.ordered(w)
        self.frame = PixelFrame.around(x, mask)
        self.points = torch.where(inside, self.frame.normalized(x), 0).permute(2, 0, 1).contiguous()
        scales = torch.as_tensor(scale, dtype=torch.float64, device=x.device).expand(x0.shape[:-2]).reshape(p)
        s2 = (scales / self.frame.pixels_per_unit).square()
        self.error = RobustSum(self.points, self.weight, loss, s2[:, None])
        is_model = (torch.isfinite(F).flatten(-2).all(-1) & (F != 0).flatten(-2).any(-1))[..., None, None]
        F = torch.where(is_model, F, F.detach())  # no gradient to what is zero or not finite
        matrices = F.to(torch.float64).reshape(p, math.prod(F.shape[x0.dim() - 2 : -2]), 3, 3)
        self._homographies = homographies
        self.models = as_components(_about_unit(self.frame.from_pixels(matrices, homographies)))

    def ordered(self, weight: PerMatch) -> Float[Tensor, "p n"]:
        """Values of matches in the caller's order in the order of `points`, 0 in padded slots; float64."""
        return torch.where(self._mask, weight.to(torch.float64).reshape(self._order.shape).gather(1, self._order), 0)

    def to_pixels(self, models: Float[Tensor, "9 p k"]) -> Float[Tensor, "p k 3 3"]:
        """Matrices in pixels, of unit norm."""
        return as_matrices(unit(as_components(self.frame.to_pixels(as_matrices(models), self._homographies))))


@torch.no_grad()
def fitted_by(
    fit: Callable[..., None], models: Float[Tensor, "9 p k"], error: RobustSum, iterations: int
) -> tuple[Float[Tensor, "9 p k"], Float[Tensor, "p k"]]:
    """Models and costs after so many steps of a kernel, fit(models (k, 9), matches, schedule, out (k, 9), cost (k,)),
    of each pair, on the CPU. A model that cannot be fitted comes back as it was, with infinite cost."""
    start = as_matrices(models).flatten(2).cpu().contiguous().numpy()
    columns, weights = (t.detach().cpu().contiguous().numpy() for t in (error.points.movedim(1, 0), error.weight))
    scales = error.s2.detach().expand_as(error.weight).cpu().contiguous().numpy()
    out, cost = np.empty_like(start), np.empty(start.shape[:2])
    for p, given in enumerate(start):
        matches = Weighted.of(columns[p], weights[p], scales[p], error.loss)
        fit(given, matches, Schedule(iterations), out[p], cost[p])
    known = np.isfinite(cost)
    fitted = torch.from_numpy(np.where(known[..., None], out, start)).to(models.device)
    return fitted.permute(2, 0, 1).contiguous(), torch.from_numpy(np.where(known, cost, np.inf)).to(models.device)


def _about_unit(F: Float[Tensor, "p k 3 3"]) -> Float[Tensor, "p k 3 3"]:
    """Matrices scaled by a power of two, which rounds nothing, so that no square under- or overflows."""
    largest = F.detach().abs().amax((-2, -1), keepdim=True)
    usual = (largest > 1e-300) & (largest < 1e300)
    largest = torch.where(usual, largest, 1)
    return F / (largest / (2 * torch.frexp(largest).mantissa))  # the power of two below the largest entry: exact
