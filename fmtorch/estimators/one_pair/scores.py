"""`scores` on the arrays of one pair: the same float32 residuals but for fused products, gains summed as integers."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

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


def matches(pair: OnePair, threshold: float, prior_weighted: bool) -> tuple[Array, Array]:
    """What each match counts (n,), and one over the square of its threshold (n,), float32; made once."""

    def made() -> tuple[Array, Array]:
        prior = pair.prior if prior_weighted else None
        support = np.ones(pair.count, np.float32) if prior is None else prior.astype(np.float32)
        return support, np.square(pair.scale / threshold).astype(np.float32)

    found: tuple[Array, Array] = pair.once(("support and scale", threshold, prior_weighted), made)
    return found


class SummedGains:
    """As `scores.SummedGains`."""

    GAIN: int

    def __init__(self, part: scores.SummedGains) -> None:
        self.part = part

    def __call__(self, F: Array, which: Array, pair: OnePair) -> Array:
        """As `Score`."""
        out = np.empty(len(which))
        support, scale = matches(pair, self.part.threshold, self.part.prior_weighted)
        bits = fractional_bits(pair.count, torch.float32)
        score_gains(F, which, pair.points32, support, scale, self.GAIN, self._table(), bits, out)
        return out

    def _table(self) -> Array:
        return NO_TABLE


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
        self._entries: Array = part.table.numpy()

    def _table(self) -> Array:
        return self._entries


class Median:
    """As `scores.Median`."""

    def __init__(self, part: scores.Median) -> None:
        pass

    def __call__(self, F: Array, which: Array, pair: OnePair) -> Array:
        """As `Score`."""
        out = np.empty(len(which))
        score_median(F, which, pair.points32, out)
        return out
