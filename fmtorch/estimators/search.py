"""The search: rounds of hypotheses, the best of which are kept, until one was all but surely made of inliers alone."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fmtorch.estimators.models.fundamental import Hypotheses, Matrices
from fmtorch.estimators.models.with_focals import FundamentalWithFocals
from fmtorch.estimators.pair import Pair
from fmtorch.estimators.preselection import Preselection
from fmtorch.estimators.sampling import Sampler, drawn
from fmtorch.geometry.matrices import assign
from fmtorch.jit.kernel import Array, F4x2, F8x1, I8x1, kernel

Stop = Callable[[Array, int, Pair, int], bool]
"""Whether the best model (9,), after so many draws of samples of this size, may be taken for the best there is."""


@dataclasses.dataclass(eq=False)
class Pool:
    """The best models of a pair, F (k, 9) float32 with descending scores (k,), of which `filled` are there.
    samples: minimal samples drawn."""

    F: Array
    score: Array
    filled: int = 0
    samples: int = 0

    @staticmethod
    def empty(size: int) -> Pool:
        """No model yet."""
        return Pool(np.zeros((size, 9), np.float32), np.full(size, -np.inf))

    @property
    def models(self) -> Array:
        """The models in float64, (m, 9); where there is none one of zeros."""
        return self.F[: max(self.filled, 1)].astype(np.float64)

    def merge(self, models: Verified) -> None:
        """Keep the best of this pool's models and the new ones; the earlier draw wins a tie."""
        self.filled = merge(models.F, models.which, models.score, self.filled, self.F, self.score)


class Verified(NamedTuple):
    """A round's models (m, 9) float32; the indices `which` (k,) of those that passed, and their scores (k,)."""

    F: Array
    which: Array
    score: Array


Degeneracy = Callable[[Hypotheses, Verified, float, Pair], Verified]
"""The models of a round, the best one completed where its sample is degenerate; the number is the score to beat."""


@dataclasses.dataclass(frozen=True)
class Search:
    """Rounds of minimal samples: drawn, solved, scored, the best kept.
    pool: the best models that are kept. hypotheses: samples drawn at most. round: samples between two looks at the
    stopping rule, None: never before `hypotheses`."""

    family: Matrices | FundamentalWithFocals
    sampler: Sampler
    preselection: Preselection
    pool: int
    hypotheses: int
    round: int
    stop: Stop | None = None
    degeneracy: Degeneracy | None = None

    def __call__(self, pair: Pair, start: int = 0) -> Pool:
        """The best models of a pair. start: draws made before."""
        pool, end = Pool.empty(self.pool), start + self.hypotheses
        while start < end:
            count = min(self.round, end - start)
            hypotheses = self.family.solve(pair, drawn(self.sampler, pair, start, count, self.family.size), start)
            models = Verified(hypotheses.F, *self.preselection(hypotheses.F, pair))
            if self.degeneracy is not None:
                models = self.degeneracy(hypotheses, models, float(pool.score[0]), pair)
            start += count
            pool.merge(models)
            pool.samples = start
            if self.stop is None or not pool.filled or start == end:
                continue
            if self.stop(pool.F[0], start, pair, self.family.size):
                break
        return pool


@kernel(holds_gil=True)
def merge(F: F4x2, which: I8x1, score: F8x1, filled: int, pool: F4x2, pool_score: F8x1) -> int:
    """Models F[which] (m, 9) with scores (k,) among the best so far -> pool (p, 9); how many there are.
    filled: places of the pool in use, which are sorted, best first. A score that is not finite is that of no model."""
    for k in range(len(which)):
        if not math.isfinite(score[k]) or (filled == len(pool_score) and not score[k] > pool_score[filled - 1]):
            continue
        place = min(filled, len(pool_score) - 1)
        while place > 0 and pool_score[place - 1] < score[k]:
            pool_score[place] = pool_score[place - 1]
            assign(pool[place], pool[place - 1])
            place -= 1
        pool_score[place] = score[k]
        assign(pool[place], F[which[k]])
        filled = min(filled + 1, len(pool_score))
    return filled
