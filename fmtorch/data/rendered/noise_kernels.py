"""Octaves of noise, compiled: only the part of the enlarged grid that is used is computed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import fused, kernel

Floats = NDArray[np.float32]
Integers = NDArray[np.int64]


@kernel("f4[:, ::1], i8[::1], f4[:, ::1], i8[::1], f4[:, ::1], f4, f4[:, ::1]")
def add_enlarged(
    grid: Floats, left: Integers, across: Floats, top: Integers, down: Floats, weight: float, total: Floats
) -> None:
    """Adds `weight` x the grid (r, c), interpolated with four by four neighbours, to `total` (h, w).

    left (w,): column of the leftmost neighbour; across (4, w): weights of the four. top (h,), down (4, h): likewise.
    Rounds as Intel's library does, which `cv2.resize` calls.
    """
    wide = np.empty((grid.shape[0], total.shape[1]), np.float32)
    for r in range(grid.shape[0]):
        for x in range(total.shape[1]):
            c = left[x]
            first = across[0, x] * grid[r, c] + across[1, x] * grid[r, c + 1]
            wide[r, x] = first + (across[2, x] * grid[r, c + 2] + across[3, x] * grid[r, c + 3])
    for y in range(total.shape[0]):
        r = top[y]
        a, b, c, d = down[0, y], down[1, y], down[2, y], down[3, y]
        for x in range(total.shape[1]):
            first = fused(b * wide[r + 1, x], a, wide[r, x])
            total[y, x] += weight * (first + fused(d * wide[r + 3, x], c, wide[r + 2, x]))
