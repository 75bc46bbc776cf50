"""Samples of matches from the definitions, one draw at a time, in Python's integers and fractions."""

import math
from collections.abc import Sequence
from fractions import Fraction


def weighted_sample(weights: Sequence[int], numbers: Sequence[int]) -> list[int]:
    """A match a number of 63 bits, each drawn by weight from those not drawn yet, which lie side by side on a line."""
    left, sample = list(range(len(weights))), []
    for number in numbers:
        position = (number >> 31) * sum(weights[i] for i in left) >> 32
        for i in left:
            if position < weights[i]:
                break
            position -= weights[i]
        left.remove(i)
        sample.append(i)
    return sample


def quantised(prior: Sequence[float], largest: int) -> list[int]:
    """Priors as whole numbers from 1 to the largest."""
    return [max(round(p * largest), 1) for p in prior]


def prosac_growth(total: int, size: int, draws: int) -> tuple[list[int], list[Fraction]]:
    """T'_n for n = 1 .. N, and what T_n grew by (Chum & Matas, CVPR 2005, equations 3 and 4); T_N: `draws`."""
    T = [
        draws * math.prod((Fraction(max(n - i, 0), total - i) for i in range(size)), start=Fraction(1))
        for n in range(total + 1)
    ]
    grown = [T[n] - T[n - 1] for n in range(1, total + 1)]
    table: list[int] = []
    for n in range(1, total + 1):
        table.append(0 if n < size else 1 if n == size else table[-1] + math.ceil(grown[n - 1]))
    return table, grown


def prosac_sample(table: Sequence[int], t: int, numbers: Sequence[int]) -> list[int]:
    """Ranks in the t-th sample, t from 1: m - 1 of those before the n-th, and that one, n the least with T'_n >= t."""
    n = next(n for n, last in enumerate(table, 1) if last >= t)
    return [*weighted_sample([1] * (n - 1), numbers), n - 1]


def priority_sample(prior: Sequence[float], numbers: Sequence[int], count: int) -> list[int]:
    """The matches of the greatest prior / (number + 1), ascending (Duffield, Lund & Thorup, J. ACM 2007)."""
    order = sorted(range(len(prior)), key=lambda i: -Fraction(prior[i]) / (numbers[i] + 1))
    return sorted(order[:count])


def shuffled(index: Sequence[int], numbers: Sequence[int], count: int) -> list[int]:
    """The first matches in the order of their numbers."""
    return sorted(index, key=lambda i: numbers[i])[:count]
