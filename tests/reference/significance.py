"""The number of false alarms of a fundamental matrix, one match after the other, from the definition."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tests.reference.epipolar import epipolar_distances

Points = NDArray[np.float64]
CELLS = 64  # of a side of the grid in which places are told apart, to the diagonal of the image
SAMPLE = 7
MODELS = 3  # of a sample
MIN_CHANCE = 2.0**-13


def significance(
    F: Points, x0: Points, x1: Points, size0: Sequence[float] | None = None, size1: Sequence[float] | None = None
) -> float:
    """-log10 of the least number of false alarms over the numbers k of matches that may be meant.

    NFA(k) = 3 (n - 7) C(n, k) C(k, 7) alpha_k^(k - 7), alpha_k the k-th smallest chance that a point at random is as
    near its epipolar line as a match's, in the image where that is more likely. Of the matches that join one cell of
    image 0 to one cell of image 1 the median one counts, the upper one of two. Minus infinity for n < 8.
    """
    if len(x0) == 0:
        return -math.inf
    chances, cells = [[0.0] * len(x0)], []
    for image, (x, size) in enumerate(((x0, size0), (x1, size1))):
        low = x.min(0)
        h, w = size if size is not None else (x.max(0) - low)[::-1]
        diagonal, area = math.hypot(h, w), h * w
        if diagonal == 0:
            return -math.inf
        distances = [epipolar_distances(F, a, b)[image] for a, b in zip(x0, x1, strict=True)]
        chances.append([2 * d * diagonal / area if area > 0 else 1.0 for d in distances])
        cells.append([tuple(math.floor(v) for v in (p - low) / (diagonal / CELLS)) for p in x])
    alphas = [min(max(per_match), 1.0) for per_match in zip(*chances, strict=True)]
    groups: dict[object, list[float]] = {}
    for alpha, *cell in zip(alphas, *cells, strict=True):
        groups.setdefault(tuple(cell), []).append(alpha)
    counted = sorted(sorted(group)[len(group) // 2] for group in groups.values())
    n = len(counted)
    best = -math.inf
    for k in range(SAMPLE + 1, n + 1):
        tests = MODELS * (n - SAMPLE) * math.comb(n, k) * math.comb(k, SAMPLE)
        alpha = max(counted[k - 1], MIN_CHANCE)
        best = max(best, -math.log10(tests) - (k - SAMPLE) * math.log10(alpha))
    return best
