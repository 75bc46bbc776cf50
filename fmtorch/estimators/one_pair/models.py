"""`models` as arrays of one pair: what a generator of hypotheses makes, a search keeps and the engine selects."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.pool_kernels import merge


@dataclasses.dataclass(frozen=True, eq=False)
class Models:
    """Hypotheses of one round in the order of their draws: F (m, 9) float32, and the draw (m,) that each is made of.

    samples: (size, s), the matches of the draws start, start + 1, ... which: (k,), the models that are left once
    verified, in their order. score: theirs, (k,); larger is better.
    """

    F: Array
    draw: Array
    samples: Array
    start: int
    which: Array | None = None
    score: Array | None = None

    def sample_of(self, draw: int) -> Array:
        """The matches (size,) of a draw."""
        sample: Array = self.samples[:, draw - self.start]
        return sample


@dataclasses.dataclass(eq=False)
class Pool:
    """The best models of a pair, F (k, 9) float32 with descending scores (k,), of which `filled` are there.

    draw: (k,), that each model is made of. draws: minimal samples drawn. near: the pair with the matches on which these
    models are refined; then they are float64.
    """

    F: Array
    score: Array
    draw: Array
    filled: int = 0
    draws: int = 0
    near: OnePair | None = None

    @staticmethod
    def of(pair: OnePair, size: int) -> Pool:
        """Nothing found yet."""
        return Pool(np.zeros((size, 9), np.float32), np.full(size, -np.inf), np.zeros(size, np.int64))

    @property
    def models(self) -> Array:
        """The models in float64, (m, 9); where there is none one of zeros."""
        return self.F[: max(self.filled, 1)].astype(np.float64)

    @property
    def valid(self) -> Array:
        """Which of `models` are there."""
        return np.arange(max(self.filled, 1)) < self.filled

    def merge(self, rows: Sequence[int], models: Models) -> None:
        """Keep the best of this pool's models and the new ones; the earlier draw wins a tie."""
        assert models.which is not None
        assert models.score is not None
        finite = np.isfinite(models.score)
        which, score = models.which[finite], models.score[finite]
        self.filled = merge(models.F, which, score, models.draw, self.filled, self.F, self.score, self.draw)

    def drawn(self, rows: Sequence[int], draws: int) -> None:
        """So many samples were drawn until now."""
        self.draws = draws

    def best_score(self, rows: Sequence[int]) -> float:
        """The score of the best model, minus infinity where there is none."""
        return float(self.score[0])

    def best(self, rows: Sequence[int]) -> tuple[Array, int]:
        """The best model (9,), zero where there is none, and the samples drawn."""
        return self.F[0], self.draws
