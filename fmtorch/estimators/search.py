"""The search: rounds of hypotheses, the best of which are kept, until one was all but surely made of inliers alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import torch

from fmtorch.estimators.models import Models, Pool
from fmtorch.estimators.pairs import NormalizedPairs

Confident = Callable[[Any, Any, Any], list[bool]]
"""Whether the best model of each pair, after so many draws, may be taken for the best there is; in either form."""


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
    """One loop for every generator, in both forms: of pairs in tensors, and of one pair in arrays.

    verify: scores models, drops weak ones. pool: the best models that are kept. hypotheses: samples drawn at most.
    round: samples between two looks at the stopping rule `confident`, None: never before `hypotheses`. degeneracy:
    completes a best model whose sample is degenerate. nothing: makes the empty pool of pairs, in the form of the parts.
    """

    generator: Any  # a Generator, or its kernel form
    verify: Callable[[Any, Any], Any]
    pool: int
    hypotheses: int
    round: int
    confident: Confident | None = None
    degeneracy: Any = None  # a Degensac, or its kernel form
    nothing: Callable[[Any, int], Any] = Pool.of

    def __call__(self, pairs: NormalizedPairs, start: int = 0) -> Pool:
        """The best models of each pair. start: draws made before."""
        at_once = self.generator.samples_at_once(pairs.points.device) // min(self.hypotheses, self.round)
        tiles = torch.split(torch.arange(len(pairs), device=pairs.row.device), max(1, at_once))
        return Pool.joined([self.rounds(pairs.only(tile), start) for tile in tiles])

    def rounds(self, pairs: Any, start: int = 0) -> Any:
        """The pool of pairs that are searched together. start: draws made before."""
        pool = self.nothing(pairs, self.pool)
        active = list(range(len(pairs)))
        end = start + self.hypotheses
        while start < end and active:
            count = min(self.round, end - start)
            some = pairs.only(active)
            models = self.verify(self.generator(some, start, count), some)
            if self.degeneracy is not None:
                models = self.degeneracy(models, pool.best_score(active), some)
            start += count
            pool.merge(active, models)
            pool.drawn(active, start)
            if self.confident is not None and start < end:
                F, drawn = pool.best(active)
                done = self.confident(F, drawn, some)
                active = [row for row, stop in zip(active, done, strict=True) if not stop]
        return pool
