"""Sizes of images as their matched points tell them, one pair and one number at a time."""

import math

import numpy as np

Sizes = list[tuple[float, float]]


def extents(x0: np.ndarray, x1: np.ndarray) -> Sizes | None:
    """The sizes (h, w) of both images; None where the points (n, 2) tell none."""
    there = [(a, b) for a, b in zip(x0.tolist(), x1.tolist(), strict=True) if all(map(math.isfinite, a + b))]
    n, sizes = len(there), []
    for i in range(2):
        x, y = [pair[i][0] for pair in there], [pair[i][1] for pair in there]
        if n < 20 or min(x + y) <= -1 or min(max(x), max(y)) <= 10:
            return None
        sizes.append((max(y) * (1 + 1.5 / n) + 0.5, max(x) * (1 + 1.5 / n) + 0.5))
    return sizes


def assumed(sizes: Sizes, one_size: float, two_sizes: float) -> tuple[Sizes, bool]:
    """The sizes that are taken, and whether they are doubtful; of the significance of estimates of one size and two."""
    (h0, w0), (h1, w1) = sizes
    same = [(max(h0, h1), max(w0, w1))] * 2
    if (h0 > w0) != (h1 > w1) and max(same[0]) < 1.2 * min(same[0]):  # one upright, one not
        long, short = max(h0, w0, h1, w1), max(min(h0, w0), min(h1, w1))
        same = [(long, short) if h > w else (short, long) for h, w in sizes]
    doubtful = any(a / b > 1.1 for one, own in zip(same, sizes, strict=True) for a, b in zip(one, own, strict=True))
    return (sizes if doubtful and two_sizes > one_size + 3 else same), doubtful
