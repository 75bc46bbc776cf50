"""`models` as arrays of one pair: what a generator of hypotheses makes, a search keeps and the engine selects."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.pool_kernels import merge


class Models(NamedTuple):
    """Hypotheses of one round in the order of their draws: F (m, 9) float32, and the draw (m,) that each is made of.

    draw: counted from `start`. samples: (size, s), the matches of the draws start, start + 1, ... which: (k,), the
    models that are left once verified, in their order. score: theirs, (k,); larger is better.
    """

    F: Array
    draw: Array
    samples: Array
    start: int
    which: Array | None = None
    score: Array | None = None

    def sample_of(self, draw: int) -> Array:
        """The matches (size,) of a draw, counted from `start`."""
        sample: Array = self.samples[:, draw]
        return sample


@dataclasses.dataclass(eq=False)
class Pool:
    """The best models of a pair, F (k, 9) float32 with descending scores (k,), of which `filled` are there.

    draws: minimal samples drawn. near: the pair with the matches on which these models are refined; then they are
    float64.
    """

    F: Array
    score: Array
    filled: int = 0
    draws: int = 0
    near: OnePair | None = None

    @staticmethod
    def of(pair: OnePair, size: int) -> Pool:
        """Nothing found yet."""
        return Pool(np.zeros((size, 9), np.float32), np.full(size, -np.inf))

    @property
    def models(self) -> Array:
        """The models in float64, (m, 9); where there is none one of zeros."""
        return self.F[: max(self.filled, 1)].astype(np.float64)

    @property
    def valid(self) -> Array:
        """Which of `models` are there."""
        return np.ones(self.filled, np.bool_) if self.filled else np.zeros(1, np.bool_)

    def merge(self, rows: Sequence[int], models: Models) -> None:
        """Keep the best of this pool's models and the new ones; the earlier draw wins a tie."""
        assert models.which is not None
        assert models.score is not None
        self.filled = merge(models.F, models.which, models.score, self.filled, self.F, self.score)

    def drawn(self, rows: Sequence[int], draws: int) -> None:
        """So many samples were drawn until now."""
        self.draws = draws

    def best_score(self, rows: Sequence[int]) -> float:
        """The score of the best model, minus infinity where there is none."""
        return float(self.score[0])

    def best(self, rows: Sequence[int]) -> tuple[Array, int]:
        """The best model (9,), zero where there is none, and the samples drawn."""
        return self.F[0], self.draws
