"""Which of the candidates is the estimate: choices that look at the pool only."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.estimators.problem import Problem
from fmtorch.estimators.scoring import SaturatedGains, score_models


@dataclasses.dataclass(frozen=True, eq=False)
class TwoCameras:
    """Cameras of square pixels and central principal points, ``E = U diag(1, 1, 0) V^T``; NaN where none are assumed.

    axes: U and V, (3, 3, 2, P), rows first. focal: the logarithms of the focal lengths in units of the longer sides,
    (2, P). Of several candidates a pair, (3, 3, 2, P, K) and (2, P, K).
    """

    axes: Tensor
    focal: Tensor

    @staticmethod
    def none(problem: Problem) -> TwoCameras:
        """No assumption about any pair."""
        p, points = len(problem.pair), problem.points
        return TwoCameras(points.new_full((3, 3, 2, p), torch.nan), points.new_full((2, p), torch.nan))

    @property
    def known(self) -> Bool[Tensor, " p"]:
        """Where cameras are assumed."""
        return torch.isfinite(self.focal[0])

    def __getitem__(self, index: Tensor) -> TwoCameras:
        """Those of the selected pairs."""
        return TwoCameras(self.axes[:, :, :, index], self.focal[:, index])

    def joined(self, other: TwoCameras) -> TwoCameras:
        """The candidates of both."""
        return TwoCameras(torch.cat([self.axes, other.axes], -1), torch.cat([self.focal, other.focal], -1))


class Chosen(NamedTuple):
    """The estimates, of unit norm, and the cameras that were assumed."""

    F: Float[Tensor, "9 p"]
    cameras: TwoCameras

    def replaced(self, index: Int[Tensor, " q"], other: Chosen) -> Chosen:
        """With other estimates for the pairs of these indices."""
        cameras = TwoCameras(
            self.cameras.axes.index_copy(3, index, other.cameras.axes),
            self.cameras.focal.index_copy(1, index, other.cameras.focal),
        )
        return Chosen(self.F.index_copy(1, index, other.F), cameras)


@runtime_checkable
class Choice(Protocol):
    """Chooses one model for each pair from a small pool of them; may improve it."""

    def __call__(
        self,
        F: Float[Tensor, "9 p k"],
        alive: Bool[Tensor, "p k"],
        problem: Problem,
        near: Problem,
    ) -> Chosen:
        """The estimates, of models of unit norm.

        alive: False for slots of the pool that hold no model. problem: the pairs with all matches, near: with those on
        which models are refined.
        """
        ...


def ranked(
    F: Float[Tensor, "9 p k"], score: Float[Tensor, "p k"], most: int
) -> tuple[Float[Tensor, "9 p m"], Float[Tensor, "p m"]]:
    """The models of the largest scores, in their order, and these; of equals the first."""
    top, order = torch.sort(score, dim=1, descending=True, stable=True)
    return F.gather(2, order[:, :most].expand(9, -1, -1)), top[:, :most]


def best_of(F: Float[Tensor, "9 p k"], score: Float[Tensor, "p k"], alive: Bool[Tensor, "p k"]) -> Float[Tensor, "9 p"]:
    """The living model of the largest score, the first of several."""
    return ranked(F, torch.where(alive, score, -torch.inf), 1)[0][..., 0]


class SaturatedChoice:
    """The model of the largest `SaturatedGains`. scale: at which a match counts half, Sampson distance, px."""

    def __init__(self, scale: float) -> None:
        self.gain = SaturatedGains(scale)

    def __call__(
        self,
        F: Float[Tensor, "9 p k"],
        alive: Bool[Tensor, "p k"],
        problem: Problem,
        near: Problem,
    ) -> Chosen:
        """As `Choice`."""
        return Chosen(best_of(F, score_models(self.gain, F, problem, problem.points), alive), TwoCameras.none(problem))
