"""Few of many points: far from one another, or as dense as they are everywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.floating]


def spread(points: Points, count: int) -> NDArray[np.intp]:
    """Indices, ascending, of at most `count` points (N, D) far from one another: each the farthest from those before.

    The first is the nearest to the mean. O(N count). Ties go to the lowest index.
    """
    if len(points) <= count:
        return np.arange(len(points))
    distance = -((points - points.mean(0)) ** 2).sum(1)
    chosen = [int(distance.argmax())]
    distance = np.full(len(points), np.inf)
    for _ in range(count - 1):
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(distance.argmax()))
    return np.sort(np.array(chosen, np.intp))


def thinned(points: Points, count: int) -> NDArray[np.intp]:
    """Indices, ascending, of at most `count` points (N, 2): of a path through all of them every so many-th.

    The path goes up one strip of the plane and down the next. Dense and sparse regions keep their shares, and among
    matches so do right and wrong ones, whereas `spread` prefers what is far from the rest: the wrong.
    """
    if len(points) <= count:
        return np.arange(len(points))
    x, y = points.T
    strip = np.floor((x - x.min()) / max(np.ptp(x), np.finfo(np.float64).tiny) * np.sqrt(count))
    path = np.lexsort((np.where(strip % 2 == 0, y, -y), strip))
    return np.sort(path[(2 * np.arange(count) + 1) * len(points) // (2 * count)])
