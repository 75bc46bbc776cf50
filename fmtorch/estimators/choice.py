"""Which of the refined candidates is the estimate: choices that look at the pool only, in float64."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.estimators.problem import Problem
from fmtorch.estimators.scoring import sampson_squared

GRID = 12  # cells along each side of each image


@runtime_checkable
class Choice(Protocol):
    """Chooses one model for each pair from a small pool of them; may improve it."""

    def __call__(self, F: Float[Tensor, "9 p k"], problem: Problem, alive: Bool[Tensor, "p k"]) -> Float[Tensor, "9 p"]:
        """The estimates, of models of unit norm; alive: False for slots of the pool that hold no model."""
        ...


def best_of(F: Float[Tensor, "9 p k"], score: Float[Tensor, "p k"], alive: Bool[Tensor, "p k"]) -> Float[Tensor, "9 p"]:
    """The model of the largest score, the first of several."""
    best = torch.sort(torch.where(alive, score, -torch.inf), dim=1, descending=True, stable=True).indices[:, :1]
    return F.gather(2, best.expand(9, -1, -1))[..., 0]


class SaturatedGain:
    """The sum over grid cells of ``sqrt(sum of P (1 - r^2 / t^2))``, over both images.

    Saturates where matches crowd, so that a model which explains the whole image beats one that explains a single
    textured plane. threshold: t, Sampson distance, px.
    """

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold

    def __call__(self, F: Float[Tensor, "9 p k"], problem: Problem, alive: Bool[Tensor, "p k"]) -> Float[Tensor, "9 p"]:
        """As `Choice`: the model of the largest score."""
        return best_of(F, self.score(F, problem), alive)

    def score(self, F: Float[Tensor, "9 p k"], problem: Problem) -> Float[Tensor, "p k"]:
        """The sums; larger is better. Gains are rounded to multiples of 2^-20, so that their float64 sums are exact."""
        r2 = sampson_squared(F, problem.points) * (problem.unit / self.threshold).square()[:, None, None]
        weight = problem.live.to(r2.dtype) if problem.prior is None else problem.prior
        gain = ((1 - r2).clamp_min(0) * weight[:, None]).mul_(2.0**20).round_().mul_(2.0**-20)
        total = torch.zeros_like(gain[..., 0])
        for points in (problem.points[:2], problem.points[2:]):
            index = _cells(points, problem)[:, None].expand_as(gain)
            cells = torch.zeros(*gain.shape[:2], GRID * GRID, dtype=gain.dtype, device=gain.device)
            roots = cells.scatter_add(2, index, gain).sqrt().mul_(2.0**20).round_().mul_(2.0**-20)
            total += roots.sum(-1)
        return total


def _cells(points: Float[Tensor, "2 p n"], problem: Problem) -> Int[Tensor, "p n"]:
    """The cell of each point in a grid over the live points' bounding box."""
    low = torch.where(problem.live, points, torch.inf).amin(-1, keepdim=True)
    high = torch.where(problem.live, points, -torch.inf).amax(-1, keepdim=True)
    share = (points - low) / (high - low).clamp_min(torch.finfo(points.dtype).tiny)
    x: Tensor
    y: Tensor
    x, y = (share * GRID).nan_to_num(0).clamp(0, GRID - 1).to(torch.int64)
    return y * GRID + x
