"""`scores` on the arrays of one pair: the same float32 residuals but for fused products, gains summed as integers."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch

from fmtorch.estimators import scores
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.scores_kernels import (
    COUNT,
    GEMAN_MCCLURE,
    TABLE,
    TRUNCATED_SQUARES,
    score_gains,
    score_median,
)
from fmtorch.geometry.arithmetic import fractional_bits

NO_TABLE = np.empty(0, np.float32)


@runtime_checkable
class Score(Protocol):
    """As `scores.Score`."""

    def __call__(self, F: Array, which: Array, pair: OnePair) -> Array:
        """Scores (k,) of those of the models (m, 9), float32, that have the indices `which` (k,), on all matches."""
        ...


class Scored(NamedTuple):
    """What a score takes of the matches of a pair, float32: points (4, n), what each counts (n,), one over the square
    of its threshold (n,); and the fractional bits of gains.
    """

    points: Array
    support: Array
    scale: Array
    bits: int

    @staticmethod
    def of(pair: OnePair, threshold: float, prior_weighted: bool) -> Scored:
        """Of all matches, made once."""
        name = "scored", threshold, prior_weighted
        found: Scored | None = pair.kept.get(name)
        if found is None:
            support = pair.support.astype(np.float32) if prior_weighted else np.ones(pair.count, np.float32)
            scale = np.square(pair.scale / threshold).astype(np.float32)
            found = pair.kept[name] = Scored(pair.points32, support, scale, fractional_bits(pair.count, torch.float32))
        return found


class SummedGains:
    """As `scores.SummedGains`."""

    GAIN: int

    def __init__(self, part: scores.SummedGains) -> None:
        self.part, self.table = part, NO_TABLE

    def __call__(self, F: Array, which: Array, pair: OnePair) -> Array:
        """As `Score`."""
        out, of = np.empty(len(which)), Scored.of(pair, self.part.threshold, self.part.prior_weighted)
        score_gains(F, which, of.points, of.support, of.scale, self.GAIN, self.table, of.bits, out)
        return out


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
