"""`orientation` for one model, compiled."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fmtorch.kernels import inner

Array = NDArray[Any]


@inner
def consistently_oriented(f: Array, X: Array, size: int, stride: int, lane: int) -> Any:
    """`orientation.consistently_oriented` of a model (9,) and every stride-th point of X (4, size * stride)."""
    g0, g1, g2 = f[0] + 0.618 * f[2], f[3] + 0.618 * f[5], f[6] + 0.618 * f[8]
    h0, h1, h2 = f[1] + 0.414 * f[2], f[4] + 0.414 * f[5], f[7] + 0.414 * f[8]
    ex, ey, ez = g1 * h2 - g2 * h1, g2 * h0 - g0 * h2, g0 * h1 - g1 * h0
    ahead, behind = 0, 0
    for j in range(size):
        p = j * stride + lane
        x0, y0 = X[0, p], X[1, p]
        a, b = f[0] * x0 + f[1] * y0 + f[2], f[3] * x0 + f[4] * y0 + f[5]
        agreement = a * (ey - ez * X[3, p]) + b * (ez * X[2, p] - ex)
        ahead += agreement > 0
        behind += agreement < 0
    return ahead == size or behind == size
