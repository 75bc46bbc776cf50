"""What a generator of hypotheses makes and a search keeps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.estimators.pairs import NormalizedPairs


@dataclasses.dataclass(frozen=True, eq=False)
class Models:
    """Hypotheses of one round for P pairs, in the order of their draws.

    F: of normalised points, row by row, float32. valid: which slots hold a model. draw: the number of the draw that
    each was made of. samples: the matches of the draws start, start + 1, ... score: once verified; larger is better.
    """

    F: Float[Tensor, "9 p m"]
    valid: Bool[Tensor, "p m"]
    draw: Int[Tensor, "p m"]
    samples: Int[Tensor, "size p s"]
    start: int
    score: Float[Tensor, "p m"] | None = None

    def take(self, index: Int[Tensor, "p k"]) -> Models:
        """The models of these slots."""
        F = self.F.gather(2, index.expand(9, -1, -1))
        score = None if self.score is None else self.score.gather(1, index)
        valid, draw = self.valid.gather(1, index), self.draw.gather(1, index)
        return dataclasses.replace(self, F=F, valid=valid, draw=draw, score=score)

    def sample_of(self, draw: Int[Tensor, " p"]) -> Int[Tensor, "size p"]:
        """The matches of one draw of each pair."""
        index = (draw - self.start)[None, :, None].expand(len(self.samples), -1, -1)
        return self.samples.gather(2, index)[..., 0]


@dataclasses.dataclass(eq=False)
class Pool:
    """The best models of P pairs, with descending scores; minus infinity where a slot holds none.

    draws: minimal samples drawn. near: the pairs with the matches on which these models are refined.
    """

    F: Float[Tensor, "9 p k"]
    score: Float[Tensor, "p k"]
    draws: Int[Tensor, " p"]
    near: NormalizedPairs | None = None

    @staticmethod
    def empty(p: int, size: int, device: torch.device) -> Pool:
        """Nothing found yet."""
        return Pool(
            torch.zeros(9, p, size, device=device),
            torch.full((p, size), -torch.inf, device=device),
            torch.zeros(p, dtype=torch.int64, device=device),
        )

    @staticmethod
    def of(pairs: NormalizedPairs, size: int) -> Pool:
        """Nothing found yet of these pairs."""
        return Pool.empty(len(pairs), size, pairs.points.device)

    @staticmethod
    def joined(parts: list[Pool]) -> Pool:
        """The pools of several groups of pairs, one after the other."""
        if len(parts) == 1:
            return parts[0]
        F, score, draws = ([getattr(x, name) for x in parts] for name in ("F", "score", "draws"))
        return Pool(torch.cat(F, 1), torch.cat(score), torch.cat(draws))

    @property
    def valid(self) -> Bool[Tensor, "p k"]:
        """Which slots hold a model."""
        return torch.isfinite(self.score)

    @property
    def models(self) -> Float[Tensor, "9 p k"]:
        """The models in float64, zero where there is none."""
        return self.F.to(torch.float64)

    def merge(self, rows: Sequence[int] | Int[Tensor, " q"], models: Models) -> None:
        """Keep the best of these rows' models and the new ones; the earlier draw wins a tie."""
        assert models.score is not None
        rows = torch.as_tensor(rows, device=self.score.device)
        F = torch.cat([self.F[:, rows], models.F], 2)
        score = torch.cat([self.score[rows], models.score], 1)
        top, order = torch.sort(score, dim=1, descending=True, stable=True)
        size = self.score.shape[1]
        self.score[rows] = top[:, :size]
        self.F[:, rows] = F.gather(2, order[:, :size].expand(9, -1, -1))

    def drawn(self, rows: Sequence[int], draws: int) -> None:
        """So many samples were drawn until now for each of these rows."""
        self.draws[torch.as_tensor(rows, device=self.score.device)] = draws

    def best_score(self, rows: Sequence[int]) -> Float[Tensor, " q"]:
        """The score of the best model of each of these rows, minus infinity where there is none."""
        return self.score[torch.as_tensor(rows, device=self.score.device), 0]

    def best(self, rows: Sequence[int]) -> tuple[Float[Tensor, "9 q"], Int[Tensor, " q"]]:
        """The best model of each of these rows, zero where there is none, and the samples drawn."""
        index = torch.as_tensor(rows, device=self.score.device)
        return self.F[:, index, 0], self.draws[index]
