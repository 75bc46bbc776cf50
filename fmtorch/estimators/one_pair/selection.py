"""`selection` on the arrays of one pair: which model of the refined pool is the estimate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fmtorch.estimators.one_pair.focal.cameras import UNKNOWN, TwoCameras
from fmtorch.estimators.one_pair.models import Pool
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.one_pair.scores import Score


class Selection(NamedTuple):
    """The selected model (9,), float64, and the cameras assumed; whether there is one, and the samples drawn."""

    F: Array
    found: bool
    draws: int
    cameras: TwoCameras = UNKNOWN

    def replaced(self, rows: Sequence[int], other: Selection) -> Selection:
        """As `selection.Selection.replaced`: the other."""
        return other

    def merged(self, rows: Sequence[int], other: Selection) -> Selection:
        """As `selection.Selection.merged`."""
        return other._replace(found=other.found or self.found, draws=other.draws + self.draws)

    @property
    def matrices(self) -> Array:
        """The model as a matrix."""
        return self.F.reshape(3, 3)


class FirstOfPool:
    """As `selection.FirstOfPool`."""

    def __call__(self, pool: Pool, pair: OnePair) -> Selection:
        """As `selection.Selector`."""
        return Selection(pool.models[0], pool.filled > 0, pool.draws)


class BestScore:
    """As `selection.BestScore`, by scores of float32."""

    def __init__(self, score: Score) -> None:
        self.score = score

    def __call__(self, pool: Pool, pair: OnePair) -> Selection:
        """As `selection.Selector`."""
        models = pool.models
        score = np.where(pool.valid, scored(self.score, models, pair), -np.inf)
        return Selection(models[int(np.argmax(score))], pool.filled > 0, pool.draws)


def scored(score: Score, F: Array, pair: OnePair) -> Array:
    """Scores (k,) of models (k, 9), float64, on all matches."""
    return score(F.astype(np.float32), np.arange(len(F)), pair)
