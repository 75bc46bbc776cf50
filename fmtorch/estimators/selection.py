"""Which model of the refined pool is the estimate."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.estimators.focal.cameras import TwoCameras
from fmtorch.estimators.models import Pool
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.scores import Score, score_models


@dataclasses.dataclass(frozen=True, eq=False)
class Selection:
    """The selected models, of unit norm, and the cameras assumed; which pairs have one, and the samples drawn."""

    F: Float[Tensor, "9 p"]
    cameras: TwoCameras
    found: Bool[Tensor, " p"]
    draws: Int[Tensor, " p"]

    def replaced(self, rows: Sequence[int], other: Selection) -> Selection:
        """With other models and cameras for these pairs."""
        index = torch.tensor(rows, device=self.found.device)
        return dataclasses.replace(
            self,
            F=self.F.index_copy(1, index, other.F),
            cameras=self.cameras.replaced(index, other.cameras),
            found=self.found.index_copy(0, index, other.found),
            draws=self.draws.index_copy(0, index, other.draws),
        )

    def merged(self, rows: Sequence[int], other: Selection) -> Selection:
        """With what another search of these pairs has selected; a pair has a model if either has found one."""
        index = torch.tensor(rows, device=self.found.device)
        found, draws = other.found | self.found[index], other.draws + self.draws[index]
        return self.replaced(rows, dataclasses.replace(other, found=found, draws=draws))

    @property
    def matrices(self) -> Float[Tensor, "p 3 3"]:
        """The models as matrices."""
        return self.F.T.reshape(-1, 3, 3)


@runtime_checkable
class Selector(Protocol):
    """Selects one model for each pair from a pool of refined ones; may improve it."""

    def __call__(self, pool: Pool, pairs: NormalizedPairs) -> Selection:
        """The selection, of models of unit norm, float64."""
        ...


def ranked(
    F: Float[Tensor, "9 p k"], score: Float[Tensor, "p k"], most: int
) -> tuple[Float[Tensor, "9 p m"], Float[Tensor, "p m"]]:
    """The models of the largest scores, in their order, and these; of equals the first."""
    top, order = torch.sort(score, dim=1, descending=True, stable=True)
    return F.gather(2, order[:, :most].expand(9, -1, -1)), top[:, :most]


def best_of(F: Float[Tensor, "9 p k"], score: Float[Tensor, "p k"], valid: Bool[Tensor, "p k"]) -> Float[Tensor, "9 p"]:
    """The valid model of the largest score, the first of several."""
    return ranked(F, torch.where(valid, score, -torch.inf), 1)[0][..., 0]


def without_cameras(F: Float[Tensor, "9 p"], pool: Pool) -> Selection:
    """These models of a pool, no cameras assumed."""
    return Selection(F, TwoCameras.none(F), pool.valid.any(1), pool.draws)


class FirstOfPool:
    """The best model as the search found it."""

    def __call__(self, pool: Pool, pairs: NormalizedPairs) -> Selection:
        """As `Selector`."""
        return without_cameras(pool.F[:, :, 0].to(torch.float64), pool)


class BestScore:
    """The model of the largest score. dtype: in which scores are computed."""

    def __init__(self, score: Score, dtype: torch.dtype = torch.float32) -> None:
        self.score, self.dtype = score, dtype

    def __call__(self, pool: Pool, pairs: NormalizedPairs) -> Selection:
        """As `Selector`."""
        score = score_models(self.score, pool.F.to(self.dtype), pairs)
        return without_cameras(best_of(pool.F, score, pool.valid), pool)
