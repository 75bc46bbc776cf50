"""`sampling` for one pair, compiled: the same integer arithmetic, hence the same samples."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.random_kernels import random_bits, stream_state

Array = NDArray[Any]


@kernel("i8[::1], i8[::1], i8, i8, i8, i8[:, ::1]")
def draw(table: Array, totals: Array, mixed_seed: int, key: int, start: int, out: Array) -> None:
    """Weighted sampling without replacement, draws start, start + 1, ... -> out (size, count), indices of matches.

    table: cumulative weights (n,), below 2^30; empty for weights of one. totals: (count,), of the weights that each
    draw is made from. mixed_seed: of the seed and the stream. The algorithm is that of `sampling._without_replacement`.
    """
    size, count = out.shape
    state, guide = stream_state(mixed_seed, key), _guide(table)
    shift = _guide_shift(table)
    begin, length = np.empty(size + 1, np.int64), np.empty(size + 1, np.int64)
    for d in range(count):
        left = totals[d]
        for j in range(size):
            word = random_bits(state, (start + d) * size + j) >> np.uint64(31)
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


@inner
def draw_from(
    table: Array, totals: Array, newest: Array, order: Array, mixed_seed: int, key: int, start: int, out: Array
) -> None:  # fmt: skip
    """The samples of `one_pair.sampling.Urn` -> out (size, count).

    newest: (count,), the last match of each draw, the others being drawn from those before it; empty: all are drawn.
    order: (n,), the matches that indices stand for; empty: themselves.
    """
    drawn = len(out) - (1 if len(newest) else 0)
    draw(table, totals, mixed_seed, key, start, out[:drawn])
    for j in range(drawn, len(out)):
        for d in range(len(newest)):
            out[j, d] = newest[d]
    for j in range(len(out) if len(order) else 0):
        for d in range(out.shape[1]):
            out[j, d] = order[out[j, d]]


@kernel("f8[::1], f8, i8[::1], i8[::1]", brief=True)
def quantise(prior: Array, largest: float, weight: Array, table: Array) -> None:
    """Priors (n,) as weights from 1 up to the largest -> weight (n,), and these cumulated -> table (n,)."""
    total = np.int64(0)
    for i in range(len(prior)):
        weight[i] = max(np.int64(np.rint(prior[i] * largest)), np.int64(1))
        total += weight[i]
        table[i] = total


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


@kernel("i8, i8, i8[::1]")
def prosac_table(size: int, growth: int, out: Array) -> None:
    """T'_n for n = 1 .. N -> out (N,): the last draw whose sample of `size` comes from the first n matches.

    growth: T_N. Chum & Matas (CVPR 2005), equations 3 and 4, as `Prosac.growth` has them.
    """
    total, before = len(out), 0.0
    draws: Any = 0
    for n in range(1, total + 1):
        expected = float(growth)
        for i in range(size):
            expected *= max(n - i, 0) / max(total - i, 1)
        if n == size:
            draws = 1
        elif n > size:
            draws += np.int64(math.ceil(expected - before))
        out[n - 1] = draws
        before = expected
