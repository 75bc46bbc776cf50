"""Octaves of noise, compiled: only the part of the enlarged grid that is used is computed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmtorch.compiling.arrays import F4x2, I8x1
from fmtorch.compiling.fused import fused
from fmtorch.compiling.kernel import kernel


class Neighbours(NamedTuple):
    """Of each of n pixels the first of the four grid points that it is interpolated from (n,), their weights (4, n)."""

    first: I8x1
    weight: F4x2


@kernel
def add_enlarged(grid: F4x2, columns: Neighbours, rows: Neighbours, weight: np.float32, total: F4x2) -> None:
    """Adds `weight` x the grid (r, c), interpolated with four by four neighbours, to `total` (h, w).

    Rounds as Intel's library does, which `cv2.resize` calls.
    """
    (left, across), (top, down) = columns, rows
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
