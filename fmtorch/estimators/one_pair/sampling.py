"""`sampling` on the arrays of one pair: the same samples."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from fmtorch.core.random import Stream, mixed_seed
from fmtorch.estimators import sampling
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.sampling_kernels import prosac_table, quantise

NONE = np.empty(0, np.int64)


class Urn(NamedTuple):
    """What the samples of some draws are drawn from, as `draw_from` takes it.

    table: (n,), cumulative weights of the matches; empty for weights of one. totals: (count,), of the weights that each
    draw is made from. newest: (count,), the last match of each sample; order: (n,), the matches that indices stand
    for; both may be empty.
    """

    table: Array
    totals: Array
    newest: Array = NONE
    order: Array = NONE


@runtime_checkable
class Sampler(Protocol):
    """As `sampling.Sampler`."""

    def urn(self, pair: OnePair, start: int, count: int, size: int) -> Urn:
        """Of samples of `size` matches, the draws start .. start + count - 1."""
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

    def urn(self, pair: OnePair, start: int, count: int, size: int) -> Urn:
        """As `Sampler.urn`."""
        return _uniform(pair, count)


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

    def urn(self, pair: OnePair, start: int, count: int, size: int) -> Urn:
        """As `Sampler.urn`."""
        if pair.quality is None and pair.prior is None:
            return _uniform(pair, count)
        table = pair.once(("growth", size), lambda pair: self.growth(pair, size))
        newest = np.minimum(np.searchsorted(table, np.arange(start + 1, start + count + 1)), pair.count - 1)
        return Urn(NONE, newest, newest, pair.once("best matches first", _best_first))


class PriorWeighted:
    """As `sampling.PriorWeighted`."""

    def __init__(self, part: sampling.PriorWeighted) -> None:
        pass

    def weight(self, pair: OnePair) -> Array:
        """As `sampling.PriorWeighted.weight`: how finely priors are quantised depends on the pair's bucket."""
        weight: Array = pair.once("weights", _quantised)[0]
        return weight

    def urn(self, pair: OnePair, start: int, count: int, size: int) -> Urn:
        """As `Sampler.urn`."""
        _, table = pair.once("weights", _quantised)
        made: Urn = pair.once(("urn", count), lambda pair: Urn(table, np.full(count, table[-1])))
        return made


def seed_of(pair: OnePair) -> int:
    """The seed of a pair's samples, mixed."""
    return mixed_seed(pair.seed, Stream.SAMPLING)


def _uniform(pair: OnePair, count: int) -> Urn:
    return Urn(NONE, np.full(count, pair.count))


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
