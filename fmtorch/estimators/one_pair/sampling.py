"""`sampling` on the arrays of one pair: the same samples."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from fmtorch.estimators import sampling
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.sampling_kernels import draw, prosac_table, quantise
from fmtorch.random import Stream, mixed_seed

WEIGHTS_OF_ONE = np.empty(0, np.int64)  # as the kernel takes them


@runtime_checkable
class Sampler(Protocol):
    """As `sampling.Sampler`."""

    def draw(self, pair: OnePair, start: int, count: int, size: int) -> Array:
        """Indices (size, count) of the matches in each of the draws start .. start + count - 1."""
        ...

    def weight(self, pair: OnePair) -> Array:
        """How likely each match is to be drawn, (n,) int64."""
        ...


class Uniform:
    """As `sampling.Uniform`."""

    def __init__(self, part: sampling.Uniform) -> None:
        pass

    def weight(self, pair: OnePair) -> Array:
        """As `Sampler.weight`."""
        return _equal_weights(pair)

    def draw(self, pair: OnePair, start: int, count: int, size: int) -> Array:
        """As `Sampler.draw`."""
        return _drawn(pair, WEIGHTS_OF_ONE, np.full(count, pair.count), start, size)


class Prosac:
    """As `sampling.Prosac`."""

    def __init__(self, part: sampling.Prosac) -> None:
        self.part = part

    def weight(self, pair: OnePair) -> Array:
        """As `Sampler.weight`."""
        return _equal_weights(pair)

    def growth(self, pair: OnePair, size: int) -> Array:
        """As `sampling.Prosac.growth`, (n,) int64."""
        table = np.empty(pair.count, np.int64)
        prosac_table(size, self.part.GROWTH, table)
        return table

    def draw(self, pair: OnePair, start: int, count: int, size: int) -> Array:
        """As `Sampler.draw`."""
        if pair.quality is None and pair.prior is None:
            return _drawn(pair, WEIGHTS_OF_ONE, np.full(count, pair.count), start, size)
        table = pair.once(("growth", size), lambda pair: self.growth(pair, size))
        newest = np.minimum(np.searchsorted(table, np.arange(start + 1, start + count + 1)), pair.count - 1)
        sample = np.vstack([_drawn(pair, WEIGHTS_OF_ONE, newest, start, size - 1), newest])
        ordered: Array = pair.once("best matches first", _best_first)[sample]
        return ordered


class PriorWeighted:
    """As `sampling.PriorWeighted`."""

    def __init__(self, part: sampling.PriorWeighted) -> None:
        pass

    def weight(self, pair: OnePair) -> Array:
        """As `sampling.PriorWeighted.weight`: how finely priors are quantised depends on the pair's bucket."""
        weight: Array = pair.once("weights", _quantised)[0]
        return weight

    def draw(self, pair: OnePair, start: int, count: int, size: int) -> Array:
        """As `Sampler.draw`."""
        _, table = pair.once("weights", _quantised)
        totals = pair.once(("totals", count), lambda pair: np.full(count, table[-1]))
        return _drawn(pair, table, totals, start, size)


def _equal_weights(pair: OnePair) -> Array:
    weight: Array = pair.once("equal weights", lambda pair: np.ones(pair.count, np.int64))
    return weight


def _quantised(pair: OnePair) -> tuple[Array, Array]:
    """Weights and cumulative weights."""
    weight, table = np.empty(pair.count, np.int64), np.empty(pair.count, np.int64)
    quantise(pair.support, 1 if pair.prior is None else sampling.largest_weight(pair.slots), weight, table)
    return weight, table


def _best_first(pair: OnePair) -> Array:
    """The matches in ascending order of quality, or in descending order of prior."""
    if pair.quality is not None:
        return np.argsort(pair.quality, kind="stable")
    assert pair.prior is not None
    return np.argsort(-pair.prior, kind="stable")


def _drawn(pair: OnePair, table: Array, totals: Array, start: int, size: int) -> Array:
    """Samples by the kernel `draw`, (size, count)."""
    sample = np.empty((size, len(totals)), np.int64)
    draw(table, totals, mixed_seed(pair.seed, Stream.SAMPLING), pair.key, start, sample)
    return sample
