"""Losses and figures of patch descriptors, written from their definitions one pair at a time."""

from collections.abc import Sequence
from math import dist

Vectors = Sequence[Sequence[float]]


def hardest_triplet(a: Vectors, b: Vectors, margin: float) -> float:
    """Mishchuk et al., NIPS 2017, section 3.1: the hardest negative of a_i among b and of b_i among a."""
    total, n = 0.0, len(a)
    for i in range(n):
        pairs = [pair for j in range(n) if j != i for pair in ((a[i], b[j]), (a[j], b[i]))]
        total += max(0.0, margin + dist(a[i], b[i]) - min(d for d in (dist(*pair) for pair in pairs) if d >= 0.008))
    return total / n
