"""`scores` on the arrays of one pair: the same float32 residuals but for fused products, gains summed as integers."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
import torch

from fmtorch.estimators import scores
from fmtorch.estimators import scores_kernels as compiled
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.pool_kernels import best
from fmtorch.estimators.scores_kernels import (
    COUNT,
    GEMAN_MCCLURE,
    TABLE,
    TRUNCATED_SQUARES,
    score_gains,
    score_median,
)
from fmtorch.estimators.verify_kernels import verify_by_gains
from fmtorch.geometry.arithmetic import fractional_bits

OfMatches = tuple[Array, Array, Array, int]  # what `matches` makes
NO_TABLE = np.empty(0, np.float32)


@runtime_checkable
class Score(Protocol):
    """As `scores.Score`."""

    def __call__(self, F: Array, which: Array, pair: OnePair) -> Array:
        """Scores (k,) of those of the models (m, 9), float32, that have the indices `which` (k,), on all matches."""
        ...

    def verify(self, F: Array, survivors: int, few: OnePair, pair: OnePair) -> tuple[Array, Array]:
        """The indices (k,), ascending, of the best k models on few matches, and their scores (k,) on all.

        Where there are no more models than survivors, all are scored at once.
        """
        ...


def matches(pair: OnePair, threshold: float, prior_weighted: bool) -> OfMatches:
    """Points (4, n), what each match counts (n,), one over the square of its threshold (n,); fractional bits of gains.

    The arrays are float32.
    """
    out = np.empty((6, pair.count), np.float32)
    compiled.matches(pair.table, threshold, prior_weighted, out)
    return out[:4], out[4], out[5], fractional_bits(pair.count, torch.float32)


def room(models: int, survivors: int) -> tuple[Array, Array]:
    """For the indices and the scores of the models that are scored on all matches."""
    k = min(models, survivors)
    return np.empty(k, np.int64), np.empty(k)


class SummedGains:
    """As `scores.SummedGains`."""

    GAIN: int

    def __init__(self, part: scores.SummedGains) -> None:
        self.part, self.table = part, NO_TABLE

    def __call__(self, F: Array, which: Array, pair: OnePair) -> Array:
        """As `Score`."""
        out = np.empty(len(which))
        points, support, scale, bits = pair.once(self, self.matches)
        score_gains(F, which, points, support, scale, self.GAIN, self.table, bits, out)
        return out

    def verify(self, F: Array, survivors: int, few: OnePair, pair: OnePair) -> tuple[Array, Array]:
        """As `Score.verify`."""
        which, score = room(len(F), survivors)
        first: OfMatches = few.once(self, self.matches)
        matches: OfMatches = pair.once(self, self.matches)
        verify_by_gains(F, *first, self.GAIN, self.table, *matches, which, score)
        return which, score

    def matches(self, pair: OnePair) -> OfMatches:
        """What kernels take of the matches."""
        return matches(pair, self.part.threshold, self.part.prior_weighted)


class InlierCount(SummedGains):
    """As `scores.InlierCount`."""

    GAIN = COUNT


class TruncatedSquares(SummedGains):
    """As `scores.TruncatedSquares`."""

    GAIN = TRUNCATED_SQUARES


class GemanMcClure(SummedGains):
    """As `scores.GemanMcClure`."""

    GAIN = GEMAN_MCCLURE


class SigmaConsensus(SummedGains):
    """As `scores.SigmaConsensus`."""

    GAIN = TABLE

    def __init__(self, part: scores.SigmaConsensus) -> None:
        super().__init__(part)
        self.table: Array = part.table.numpy()


class Median:
    """As `scores.Median`."""

    def __init__(self, part: scores.Median) -> None:
        pass

    def __call__(self, F: Array, which: Array, pair: OnePair) -> Array:
        """As `Score`."""
        out = np.empty(len(which))
        score_median(F, which, pair.points32, out)
        return out

    def verify(self, F: Array, survivors: int, few: OnePair, pair: OnePair) -> tuple[Array, Array]:
        """As `Score.verify`."""
        which, _ = room(len(F), survivors)
        every = np.arange(len(F))
        if len(which) < len(F):
            best(self(F, every, few), which)
        else:
            which = every
        return which, self(F, which, pair)
