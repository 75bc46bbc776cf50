"""The map between the surroundings of a match where there are no frames: a similarity that its neighbours agree on."""

from __future__ import annotations

import math

import numpy as np

from fmtorch.compiling.arrays import F8x2, F8x3
from fmtorch.compiling.kernel import kernel
from fmtorch.compiling.scratch import vector
from fmtorch.pruning.knn_kernels import search

NEIGHBOURS = 16
MIN_AGREEING = 3  # neighbours, without which there is no map
TOLERANCE, NOISE_PX = 0.15, 1.0  # of a prediction: relative to the distance of the neighbour, and of its position


@kernel
def neighbour_maps(x0: F8x2, x1: F8x2, out: F8x3) -> None:
    """Of each of n matches, points x0, x1 (n, 2), the similarity around it -> out (n, 2, 2); NaN for none.

    Each of its nearest neighbours in image 0 proposes the one that maps it exactly. Of the proposal with which most
    neighbours agree, the first of equals, it is the least-squares similarity of these.
    """
    n = len(x0)
    neighbors = np.empty((n, min(NEIGHBOURS + 1, n)), np.int64)
    search(x0, x0, neighbors)
    u, v, p, q = vector(NEIGHBOURS + 1), vector(NEIGHBOURS + 1), vector(NEIGHBOURS + 1), vector(NEIGHBOURS + 1)
    r = vector(NEIGHBOURS + 1)
    for i in range(n):
        out[i] = math.nan
        count = 0
        for j in neighbors[i]:
            dx, dy = x0[j, 0] - x0[i, 0], x0[j, 1] - x0[i, 1]
            if dx * dx + dy * dy > 0.0:
                u[count], v[count], p[count], q[count] = dx, dy, x1[j, 0] - x1[i, 0], x1[j, 1] - x1[i, 1]
                r[count] = dx * dx + dy * dy
                count += 1
        best = MIN_AGREEING - 1
        for proposal in range(count):
            a = (u[proposal] * p[proposal] + v[proposal] * q[proposal]) / r[proposal]
            b = (u[proposal] * q[proposal] - v[proposal] * p[proposal]) / r[proposal]
            size2, agreeing, c, d, squares = a * a + b * b, 0, 0.0, 0.0, 0.0
            for k in range(count):
                ex, ey = a * u[k] - b * v[k] - p[k], b * u[k] + a * v[k] - q[k]
                reach = TOLERANCE * math.sqrt(size2 * r[k]) + NOISE_PX
                if ex * ex + ey * ey <= reach * reach:
                    agreeing += 1
                    c += u[k] * p[k] + v[k] * q[k]
                    d += u[k] * q[k] - v[k] * p[k]
                    squares += r[k]
            if agreeing > best:
                best = agreeing
                out[i, 0, 0], out[i, 0, 1], out[i, 1, 0], out[i, 1, 1] = (
                    c / squares,
                    -d / squares,
                    d / squares,
                    c / squares,
                )
