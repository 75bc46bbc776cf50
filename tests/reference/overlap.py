"""How much two images show in common, pixel by pixel and point by point from the definitions."""

import math
from collections.abc import Callable, Sequence

import numpy as np


def by_points(seen0: Sequence[int], seen1: Sequence[int]) -> float:
    """The smaller of the shares of either image's points that the other sees; 0 where an image sees none."""
    a, b = set(seen0), set(seen1)
    if not a or not b:
        return 0.0
    return min(len(a & b) / len(a), len(a & b) / len(b))


def share(
    depth0: Callable[[float, float], float], depth1: Callable[[float, float], float],
    K0: np.ndarray, K1: np.ndarray, sizes: tuple[tuple[int, int], tuple[int, int]], R: np.ndarray, t: np.ndarray,
    step: int, tolerance: float,
) -> float:  # fmt: skip
    """The share of the pixels of image 0 with depth whose points image 1 sees at the same depth, to a tolerance.

    A depth is a function of x and y, NaN where there is none. Pixels for which the other image has none do not count.
    """
    (h0, w0), (h1, w1) = sizes
    seen = count = 0
    for y in range(step // 2, h0, step):
        for x in range(step // 2, w0, step):
            z = depth0(x, y)
            if math.isnan(z):
                continue
            X = R @ (z * np.linalg.inv(K0) @ np.array([x, y, 1.0])) + t
            count += 1
            if X[2] <= 0:
                continue
            u, v, _ = K1 @ X / X[2]
            if not (-0.5 <= u < w1 - 0.5 and -0.5 <= v < h1 - 0.5):
                continue
            there = depth1(u, v)
            if math.isnan(there):
                count -= 1
            elif abs(there - X[2]) <= tolerance * there:
                seen += 1
    return seen / count if count else 0.0
