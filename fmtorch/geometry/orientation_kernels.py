"""The oriented epipolar constraint: what lies before both cameras is on one side of the epipolar geometry."""

from __future__ import annotations

from typing import Any

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.kernel import inner
from fmtorch.compiling.lanes import fill, load


@inner
def consistently_oriented(F: Array, X: Array, size: int) -> Any:
    """Whether ``F x0`` and ``e1 x x1``, the same epipolar line, point the same way for all matches of a sample: a mask.

    Chum, Werner & Matas, "Epipolar geometry estimation via RANSAC benefits from the oriented epipolar constraint"
    (ICPR 2004). A model through a wrong match mostly fails, so a look at the sample alone tells most wrong models.
    F: (9, LANES), of rank two. X: (4 size, LANES), x0, y0, x1, y1 of the matches that each model was made from.
    """
    f0, f1, f2, f3, f4, f5 = load(F, 0), load(F, 1), load(F, 2), load(F, 3), load(F, 4), load(F, 5)
    f6, f7, f8 = load(F, 6), load(F, 7), load(F, 8)
    # The epipole is across all columns: here two combinations, which no usual epipole makes parallel.
    g0, g1, g2 = f0 + 0.618 * f2, f3 + 0.618 * f5, f6 + 0.618 * f8
    h0, h1, h2 = f1 + 0.414 * f2, f4 + 0.414 * f5, f7 + 0.414 * f8
    ex, ey, ez = g1 * h2 - g2 * h1, g2 * h0 - g0 * h2, g0 * h1 - g1 * h0
    ahead = fill(0.0) == 0.0
    behind = ahead
    for j in range(size):
        x0, y0, x1, y1 = load(X, 4 * j), load(X, 4 * j + 1), load(X, 4 * j + 2), load(X, 4 * j + 3)
        a, b = f0 * x0 + f1 * y0 + f2, f3 * x0 + f4 * y0 + f5
        agreement = a * (ey - ez * y1) + b * (ez * x1 - ex)
        ahead &= agreement > 0.0
        behind &= agreement < 0.0
    return ahead | behind
