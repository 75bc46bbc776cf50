"""Losses and figures of patch descriptors, written from their definitions one pair at a time."""

from collections.abc import Sequence
from math import dist as distance

Vectors = Sequence[Sequence[float]]


def hardest_triplet(a: Vectors, b: Vectors, margin: float) -> float:
    """Mishchuk et al., NIPS 2017, section 3.1: the hardest negative of a_i among b and of b_i among a."""
    total, n = 0.0, len(a)
    for i in range(n):
        negatives = [distance(a[i], b[j]) for j in range(n) if j != i] + [
            distance(a[j], b[i]) for j in range(n) if j != i
        ]
        hinge = max(0.0, margin + distance(a[i], b[i]) - min(d for d in negatives if d >= 0.008))
        total += hinge
    return total / n
