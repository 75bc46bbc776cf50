"""Which model of the refined pool is the estimate."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from fmtorch.estimators.models.posterior import Cameras
from fmtorch.estimators.pair import Pair
from fmtorch.estimators.refinement import Candidates
from fmtorch.estimators.scores import Score, scored
from fmtorch.jit.kernel import Array


class Selection(NamedTuple):
    """The selected model (9,), float64, whether there is one, and its cameras (1, ...), None where none are assumed."""

    F: Array
    valid: bool
    cameras: Cameras | None = None


@runtime_checkable
class Selector(Protocol):
    """Selects one model from a pool of refined ones."""

    def __call__(self, candidates: Candidates, pair: Pair) -> Selection:
        """The selection."""
        ...


class BestOfSearch:
    """The best model of the search, the first of the pool."""

    def __call__(self, candidates: Candidates, pair: Pair) -> Selection:
        """As `Selector`."""
        return Selection(candidates.F[0], bool(candidates.valid[0]))


class BestScore:
    """The model of the largest score."""

    def __init__(self, score: Score) -> None:
        self.score = score

    def __call__(self, candidates: Candidates, pair: Pair) -> Selection:
        """As `Selector`."""
        score = np.where(candidates.valid, scores_of(self.score, candidates.F, pair), -np.inf)
        return Selection(candidates.F[int(np.argmax(score))], bool(candidates.valid[0]))


def scores_of(score: Score, F: Array, pair: Pair) -> Array:
    """Scores (k,) of models (k, 9), float64, on all matches."""
    return scored(score, F.astype(np.float32), np.arange(len(F)), pair)
