"""Position consistency, match by match, from its definition."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.reference.frame_consistency import agreement as by_frames
from tests.reference.frame_consistency import morton_order


def similarity(p0: np.ndarray, p1: np.ndarray, curves: Sequence[Any], turns: int, scales: Any) -> complex:
    """The common turn and scale, a complex number: the best bin of the product of both images' smoothed histograms."""
    product = np.ones((len(scales), turns))
    for points in (p0, p1):
        order = morton_order(points, *curves[0])
        votes = np.zeros((len(scales), turns))
        for i, j in itertools.pairwise(order):
            d, u = complex(*(p0[j] - p0[i])), complex(*(p1[j] - p1[i]))
            if d == 0 or u == 0:
                continue
            level = round(2 * np.log2(abs(u / d))) + len(scales) // 2
            if 0 <= level < len(scales):
                votes[level, round(np.angle(u / d) / (2 * np.pi) * turns) % turns] += 1
        votes = 2 * votes + np.roll(votes, 1, 1) + np.roll(votes, -1, 1)
        smooth = 2 * votes
        smooth[1:] += votes[:-1]
        smooth[:-1] += votes[1:]
        product *= smooth
    bins, identity = product.size, len(scales) // 2 * turns
    best = max(range(bins), key=lambda i: (product.flat[i], -((identity - i) % bins)))  # the identity, of equals
    return scales[best // turns] * np.exp(2j * np.pi * (best % turns) / turns)


def agreement(
    x0: np.ndarray, x1: np.ndarray, S: complex, vote: np.ndarray, curves: Sequence[Any],
    window: int, tolerance: float, noise: float,
) -> np.ndarray:  # fmt: skip
    """The weighted share of neighbours along the curves whose displacement the similarity S predicts."""
    maps = np.tile([[S.real, -S.imag], [S.imag, S.real]], (len(x0), 1, 1))
    return by_frames(x0, x1, maps, vote, curves, window, tolerance, noise)
