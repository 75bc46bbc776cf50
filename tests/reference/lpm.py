"""Locality preserving matching (Ma et al., IJCV 2019), one match at a time, for one pair."""

import math
from typing import Any

import numpy as np


def nearest(query: np.ndarray, points: np.ndarray, members: list[int], count: int) -> list[int]:
    """The `count` members nearest to the query, ties by index; fewer where there are fewer."""
    among = np.array(members, dtype=int)
    nearest_first: list[int] = among[np.lexsort((among, ((points[among] - query) ** 2).sum(1)))].tolist()
    return nearest_first[:count]


def cost(i: int, x: np.ndarray, y: np.ndarray, members: list[int], K: int, tau: float) -> float:
    """Sum over the three scales of the share of neighbours that are lost or move otherwise."""
    around_x, around_y = nearest(x[i], x, members, K + 3), nearest(y[i], y, members, K + 3)
    total = 0.0
    for scale, size in enumerate((K + 2, K, K - 2)):
        near_x, near_y = around_x[1 + scale : K + 3 - scale], around_y[1 + scale : K + 3 - scale]
        common = set(near_x) & set(near_y)
        total += (size - len(common) + sum(differs(y[i] - x[i], y[j] - x[j], tau) for j in common)) / size
    return total


def differs(v: np.ndarray, w: np.ndarray, tau: float) -> bool:
    """Whether two motions differ in direction and length; motions of length zero never do."""
    v2, w2 = float((v**2).sum()), float((w**2).sum())
    if v2 == 0 or w2 == 0:
        return False
    cosine = float(v @ w) / math.sqrt(v2 * w2)
    return cosine * min(v2, w2) / max(v2, w2) < tau


def passes(
    x: np.ndarray, y: np.ndarray, thresholds: tuple[float, float] = (0.8, 0.5), neighbors: tuple[int, int] = (6, 6),
    taus: tuple[float, float] = (0.2, 0.2),
) -> tuple[list[int], list[list[float]]]:  # fmt: skip
    """The survivors of two passes, and the costs in each; in the second neighbours are sought among the survivors."""
    members, costs = list(range(len(x))), []
    for passing, (threshold, K, tau) in enumerate(zip(thresholds, neighbors, taus, strict=True)):
        if passing == 1 and len(members) < K + 4:
            break
        costs.append([cost(i, x, y, members, K, tau) / 3 for i in range(len(x))])
        members = [i for i in range(len(x)) if costs[-1][i] <= threshold]
    return members, costs


def lpm(x: np.ndarray, y: np.ndarray, *options: Any) -> np.ndarray:
    return np.isin(np.arange(len(x)), passes(x, y, *options)[0])
