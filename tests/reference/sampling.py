"""Samples and subsets of matches, one number at a time, from the definitions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

from tests.reference.random import number

WORD_BITS = 31  # of a random number's 63, those that are left out


def weighted_sample(weights: Sequence[int], size: int, seed: int, key: int, stream: int, draw: int) -> list[int]:
    """`size` different matches, each drawn in proportion to the weights of those that are left."""
    left, chosen = list(range(len(weights))), []
    for j in range(size):
        word = number(seed, key, stream, draw, j, size) >> WORD_BITS
        position = word * sum(weights[i] for i in left) >> 32
        for i in left:
            if position < weights[i]:
                break
            position -= weights[i]
        chosen.append(i)
        left.remove(i)
    return chosen


def prosac_growth(count: int, size: int, draws: int) -> list[int]:
    """T'_n for n = 1 .. count (Chum & Matas, CVPR 2005, equations 3 and 4), with exact fractions."""
    table: list[int] = []
    expected = Fraction(0)
    for n in range(1, count + 1):
        before, expected = expected, Fraction(draws)
        for i in range(size):
            expected *= Fraction(max(n - i, 0), count - i)
        table.append(0 if n < size else 1 if n == size else table[-1] + math.ceil(expected - before))
    return table


def prosac_sample(
    order: Sequence[int], newest: int, size: int, seed: int, key: int, stream: int, draw: int
) -> list[int]:
    """The match of rank `newest`, and `size` - 1 of those before it, all alike."""
    others = weighted_sample([1] * newest, size - 1, seed, key, stream, draw)
    return [order[i] for i in [*others, newest]]


def shuffled(indices: Sequence[int], seed: int, key: int, stream: int) -> list[int]:
    """Matches by their random numbers."""
    return sorted(indices, key=lambda i: number(seed, key, stream, i, 0, 1))


def by_priority(prior: Sequence[float], seed: int, key: int, stream: int) -> list[int]:
    """Matches by falling prior / u: priority sampling (Duffield, Lund & Thorup, J. ACM 2007)."""
    u = [float(number(seed, key, stream, i, 0, 1)) + 1 for i in range(len(prior))]
    return sorted(range(len(prior)), key=lambda i: -prior[i] / u[i])
