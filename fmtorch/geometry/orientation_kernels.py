"""`orientation` for LANES models, compiled."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner
from fmtorch.compiling.lanes import fill, load

Array = NDArray[Any]


@inner
def consistently_oriented(F: Array, X: Array, size: int) -> Any:
    """`orientation.consistently_oriented` of models (9, LANES), each with its own points X (4 size, LANES): a mask."""
    f0, f1, f2, f3, f4, f5 = load(F, 0), load(F, 1), load(F, 2), load(F, 3), load(F, 4), load(F, 5)
    f6, f7, f8 = load(F, 6), load(F, 7), load(F, 8)
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
