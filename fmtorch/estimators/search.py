"""The search: rounds of hypotheses, the best of which are kept, until one was all but surely made of inliers alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fmtorch.estimators.degeneracy import Degensac
from fmtorch.estimators.models import Models, Pool
from fmtorch.estimators.pairs import NormalizedPairs

Confident = Callable[[Float[Tensor, "9 p"], Int[Tensor, " p"], NormalizedPairs], list[bool]]
"""Whether the best model of each pair, after so many draws, may be taken for the best there is."""


@runtime_checkable
class Generator(Protocol):
    """Makes hypotheses of minimal samples. size: matches of a sample. samples_at_once: of all pairs; bounds memory."""

    size: int

    def samples_at_once(self, device: torch.device) -> int:
        """How many samples of all pairs are solved together; changes no result."""
        ...

    def __call__(self, pairs: NormalizedPairs, start: int, count: int) -> Models:
        """The models of the draws start .. start + count - 1, in their order."""
        ...


@dataclasses.dataclass(frozen=True)
class Search:
    """One loop for every generator.

    verify: scores models, drops weak ones. pool: the best models that are kept. hypotheses: samples drawn at most.
    round: samples between two looks at the stopping rule `confident`, None: never before `hypotheses`. degeneracy:
    completes a best model whose sample is degenerate.
    """

    generator: Generator
    verify: Callable[[Models, NormalizedPairs], Models]
    pool: int
    hypotheses: int
    round: int
    confident: Confident | None = None
    degeneracy: Degensac | None = None

    def __call__(self, pairs: NormalizedPairs) -> Pool:
        """The best models of each pair."""
        at_once = self.generator.samples_at_once(pairs.points.device) // min(self.hypotheses, self.round)
        tiles = torch.split(torch.arange(len(pairs), device=pairs.row.device), max(1, at_once))
        return Pool.joined([self._tile(pairs.only(tile)) for tile in tiles])

    def _tile(self, pairs: NormalizedPairs) -> Pool:
        pool = Pool.empty(len(pairs), self.pool, pairs.points.device)
        active = list(range(len(pairs)))
        start = 0
        while start < self.hypotheses and active:
            count = min(self.round, self.hypotheses - start)
            rows, some = torch.tensor(active, device=pairs.row.device), pairs.only(active)
            models = self.verify(self.generator(some, start, count), some)
            if self.degeneracy is not None:
                models = self.degeneracy(models, pool.score[rows, 0], some)
            pool.merge(rows, models)
            start += count
            pool.draws[rows] = start
            if self.confident is not None and start < self.hypotheses:
                done = self.confident(pool.F[:, rows, 0], pool.draws[rows], some)
                active = [row for row, stop in zip(active, done, strict=True) if not stop]
        return pool
