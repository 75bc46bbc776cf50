"""Confidence intervals by resampling whole scenes, because the pairs of one scene are not independent."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 2000
LEVEL = 0.95
MIN_SCENES = 5  # with fewer scenes their spread cannot be seen, and pairs are resampled
_SEED = 0
_BLOCK = 1 << 22  # numbers drawn at once: bounds the memory to some 100 MB


@dataclasses.dataclass(frozen=True)
class Interval:
    """A mean with its percentile bootstrap interval. over: what was resampled, ``scene`` or ``pair``.

    As text it is ``value [low, high]``, each number in the given format: ``f"{interval:+.1f}"``.
    """

    value: float
    low: float
    high: float
    over: str

    def __format__(self, form: str) -> str:
        return f"{self.value:{form}} [{self.low:{form}}, {self.high:{form}}]"


def bootstrap_mean(values: NDArray[np.float64], scenes: Sequence[str]) -> Interval:
    """The mean over all pairs, with a 95 % percentile interval from 2,000 resamples of scenes (Efron 1979).

    values: one per pair, (n,), n >= 1. scenes: the scene of each pair. With fewer than `MIN_SCENES` scenes the pairs
    are resampled instead, which is too narrow where pairs of a scene succeed and fail together. The interval has no
    width where all values are equal. The same input always gives the same interval.
    """
    _, cluster = np.unique(np.asarray(scenes), return_inverse=True)
    over = "scene" if cluster.max() + 1 >= MIN_SCENES else "pair"
    if over == "pair":
        cluster = np.arange(len(values))
    sums, sizes = np.bincount(cluster, values), np.bincount(cluster)
    means = np.concatenate([sums[draw].sum(1) / sizes[draw].sum(1) for draw in _draws(len(sums))])
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(float(sums.sum() / len(values)), float(low), float(high), over)


def paired_bootstrap(a: NDArray[np.float64], b: NDArray[np.float64], scenes: Sequence[str]) -> Interval:
    """mean(a) - mean(b) of two methods on the same pairs, as `bootstrap_mean` of the differences.

    a, b: (n,), e.g. 1.0 where NSGD is below the threshold. The methods differ at this level where the interval does
    not hold 0.
    """
    if len(a) != len(b):
        raise ValueError(f"paired_bootstrap compares the same pairs, but a has {len(a)} and b has {len(b)}")
    return bootstrap_mean(a - b, scenes)


def _draws(count: int) -> Iterator[NDArray[np.int64]]:
    """`RESAMPLES` samples with replacement of `count` clusters, in blocks (r, count)."""
    rng = np.random.default_rng(_SEED)
    rows = max(1, min(RESAMPLES, _BLOCK // count))
    for start in range(0, RESAMPLES, rows):
        yield rng.integers(0, count, (min(rows, RESAMPLES - start), count))
