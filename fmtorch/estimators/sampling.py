"""Which matches a minimal sample holds: a stateless function of (seed, pair key, draw)."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from fmtorch.estimators.pair import Pair
from fmtorch.jit.kernel import Array, I8x1, I8x2, inner, kernel
from fmtorch.jit.random import Stream, random_bits, stream_state

TOTAL_BITS = 30  # cumulative weights stay below 2^30, so that 32 random bits times a total fit an int64
NONE = np.empty(0, np.int64)


@runtime_checkable
class Sampler(Protocol):
    """Draws minimal samples without replacement."""

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Array:
        """Indices (size, count) int64 of the matches in each of the draws start .. start + count - 1."""
        ...


class Draws(NamedTuple):
    """What samples are drawn from.
    table: (n,), cumulative weights of the matches, below 2^30; empty for weights of one. totals: (count,), of the
    weights that each draw is made from. newest: (count,), the last match of each draw, the others being drawn from
    those before it; empty: all are drawn. order: (n,), the matches that indices stand for; empty: themselves.
    seed: of the stream, mixed. start: the number of the first draw."""

    table: I8x1
    totals: I8x1
    newest: I8x1
    order: I8x1
    seed: int
    key: int
    start: int


class Uniform:
    """Every set of matches is equally likely."""

    def weight(self, pair: Pair) -> Array:
        """How likely each match is to be drawn, relative to the others, for the stopping rule: (n,) int64, ones."""
        return pair.cached("equal weights", lambda pair: np.ones(pair.count, np.int64))

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Array:
        """As `Sampler.draw`."""
        return _drawn(pair, start, size, NONE, np.full(count, pair.count))


class Prosac(Uniform):
    """PROSAC (Chum & Matas, CVPR 2005): samples from the best matches first, from all of them in the end.

    Matches are ranked by ambiguity, smaller first, or by prior where there is no ambiguity; without either all sets are
    equally likely, since the order of matches means nothing. Draw t takes the n(t)-th match and the others from those
    before it, n(t) growing as the paper's equation 3 says for T_N draws; after these all sets are equally likely."""

    GROWTH = 200_000  # T_N: after so many draws PROSAC is RANSAC; the paper's value

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Array:
        """As `Sampler.draw`."""
        if pair.ambiguity is None and pair.prior is None:
            return super().draw(pair, start, count, size)
        table = pair.cached(("growth", size), lambda pair: self.growth(pair.count, size))
        ranked = min(max(int(table[-1]) - start, 0), count)
        newest = np.searchsorted(table, np.arange(start + 1, start + ranked + 1))
        sample = _drawn(pair, start, size, NONE, newest, newest, pair.cached("best matches first", _best_first))
        if ranked == count:
            return sample
        return np.concatenate([sample, super().draw(pair, start + ranked, count - ranked, size)], 1)

    def growth(self, count: int, size: int) -> Array:
        """T'_n for n = 1 .. N: the last draw whose sample comes from the first n matches (equation 4), (n,) int64."""
        n, expected = np.arange(1, count + 1), np.full(count, float(self.GROWTH))
        for i in range(size):  # equation 3
            expected = expected * (np.maximum(n - i, 0) / max(count - i, 1))
        steps = np.ceil(np.diff(expected, prepend=0.0)).astype(np.int64)
        return np.cumsum(np.where(n > size, steps, n == size))


class PriorWeighted:
    """Matches drawn in proportion to their prior P(inlier); uniform where there is none."""

    uses_prior = True

    def weight(self, pair: Pair) -> Array:
        """The priors, quantised so that their sums are exact: (n,) int64."""
        return pair.cached("weights", _quantised)[0]

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Array:
        """As `Sampler.draw`."""
        table = pair.cached("weights", _quantised)[1]
        totals = pair.cached(("totals", count), lambda pair: np.full(count, table[-1]))
        return _drawn(pair, start, size, table, totals)


def drawn(sampler: Sampler, pair: Pair, start: int, count: int, size: int) -> Array:
    """What a sampler draws; ValueError where these are no samples of a pair's matches."""
    sample, kind = sampler.draw(pair, start, count, size), type(sampler)
    if kind in OWN:
        return sample
    if not isinstance(sample, np.ndarray) or sample.shape != (size, count) or sample.dtype.kind not in "iu":
        what = f"{sample.dtype} {sample.shape}" if isinstance(sample, np.ndarray) else type(sample).__name__
        raise ValueError(
            f"{kind.__name__}.draw returns {what}; it must be an array of int64 {(size, count)}: "
            f"{size} indices of matches for each of {count} draws"
        )
    if sample.min() < 0 or sample.max() >= pair.count:
        raise ValueError(
            f"{kind.__name__}.draw returns indices from {sample.min()} to {sample.max()}; they must be from 0 to "
            f"{pair.count - 1}, of the {pair.count} matches of the pair"
        )
    return np.ascontiguousarray(sample, np.int64)


def largest_weight(bucket: int) -> int:
    """The weight of a prior of one in a bucket of so many slots."""
    return 1 << (TOTAL_BITS - (bucket - 1).bit_length())


OWN = (Uniform, Prosac, PriorWeighted)


def _drawn(
    pair: Pair, start: int, size: int, table: Array, totals: Array, newest: Array = NONE, order: Array = NONE
) -> Array:
    out = np.empty((size, len(totals)), np.int64)
    draw(Draws(table, totals, newest, order, pair.mixed_seed(Stream.SAMPLING), pair.key, start), out)
    return out


def _quantised(pair: Pair) -> tuple[Array, Array]:
    largest = 1.0 if pair.prior is None else largest_weight(pair.bucket)
    weight = np.maximum(np.rint(pair.match_weight * largest).astype(np.int64), 1)
    return weight, np.cumsum(weight)


def _best_first(pair: Pair) -> Array:
    """The matches in ascending order of ambiguity, or in descending order of prior."""
    if pair.ambiguity is not None:
        return np.argsort(pair.ambiguity, kind="stable")
    assert pair.prior is not None
    return np.argsort(-pair.prior, kind="stable")


@kernel
def draw(draws: Draws, out: I8x2) -> None:
    """Weighted sampling without replacement: intervals already drawn are cut out of [0, total) -> out (size, count).
    A position is drawn in what is left and pushed past every drawn interval in ascending order; the table says whose
    interval it falls in. Without a table every interval has length one."""
    table, totals, newest, order, seed, key, start = draws
    count, drawn = out.shape[1], len(out) - (1 if len(newest) else 0)
    state, guide, shift = stream_state(seed, key), _guide(table), _guide_shift(table)
    begin, length = np.empty(drawn + 1, np.int64), np.empty(drawn + 1, np.int64)
    for d in range(count):
        left = totals[d]
        for j in range(drawn):
            word = random_bits(state, (start + d) * drawn + j) >> np.uint64(31)
            position = np.int64(word * np.uint64(left) >> np.uint64(32))
            for k in range(j):  # intervals chosen already, in ascending order
                if position < begin[k]:
                    break
                position += length[k]
            index: Any = position
            first: Any = position
            weight: Any = 1
            if len(table):
                index = guide[position >> shift]
                while table[index] <= position:
                    index += 1
                first = table[index - 1] if index else 0
                weight = table[index] - first
            out[j, d] = index
            left -= weight
            k = j
            while k > 0 and begin[k - 1] > first:
                begin[k], length[k] = begin[k - 1], length[k - 1]
                k -= 1
            begin[k], length[k] = first, weight
    for j in range(drawn, len(out)):
        for d in range(count):
            out[j, d] = newest[d]
    for j in range(len(out) if len(order) else 0):
        for d in range(count):
            out[j, d] = order[out[j, d]]


@inner
def _guide_shift(table: Array) -> int:
    """Positions are looked up by their upper bits: about as many different ones as there are matches."""
    shift = 0
    while len(table) and (table[-1] >> shift) > 2 * len(table):
        shift += 1
    return shift


@inner
def _guide(table: Array) -> Array:
    """For each value of a position's upper bits the match that the first such position belongs to."""
    if len(table) == 0:
        return np.empty(0, np.int64)
    shift, index = _guide_shift(table), 0
    guide = np.empty((table[-1] >> shift) + 1, np.int64)
    for entry in range(len(guide)):
        while index < len(table) - 1 and table[index] <= entry << shift:
            index += 1
        guide[entry] = index
    return guide
