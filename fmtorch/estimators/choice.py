"""Which of the candidates is the estimate: choices that look at the pool only."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.estimators.problem import Problem
from fmtorch.estimators.scoring import SaturatedGains, score_models


@runtime_checkable
class Choice(Protocol):
    """Chooses one model for each pair from a small pool of them; may improve it."""

    def __call__(
        self, F: Float[Tensor, "9 p k"], problem: Problem, near: Problem, alive: Bool[Tensor, "p k"]
    ) -> Float[Tensor, "9 p"]:
        """The estimates, of models of unit norm.

        problem: the pairs with all matches, near: with those on which models are refined. alive: False for slots of
        the pool that hold no model.
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
        self, F: Float[Tensor, "9 p k"], problem: Problem, near: Problem, alive: Bool[Tensor, "p k"]
    ) -> Float[Tensor, "9 p"]:
        """As `Choice`."""
        return best_of(F, score_models(self.gain, F, problem, problem.points), alive)
