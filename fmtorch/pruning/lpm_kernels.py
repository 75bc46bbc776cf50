"""`lpm` for one pair, compiled."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, B1x1, F8x1, F8x2, I8x1
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.scratch import vector
from fmtorch.pruning.knn_kernels import search


class Passes(NamedTuple):
    """Of each pass (p,) the cost up to which matches are kept, neighbours, and the agreement of motions that differ."""

    thresholds: F8x1
    neighbors: I8x1
    taus: F8x1


@kernel
def lpm(x0: F8x2, x1: F8x2, mask: B1x1, passes: Passes, out: F8x2) -> None:
    """`lpm.lpm` of x0, x1 (n, 2), mask (n,) -> out[0] (n,), 1 for matches that are kept; `lpm.lpm_cost` -> out[1]."""
    thresholds, neighbors, taus = passes
    n, m = len(mask), 0
    out[0], out[1] = 0, 1
    match, points = np.empty(n, np.int64), np.empty((2, n, 2))
    for i in range(n):
        finite = math.isfinite(x0[i, 0]) and math.isfinite(x0[i, 1])
        match[m] = i
        for k in range(2):
            points[0, m, k], points[1, m, k] = x0[i, k], x1[i, k]
        m += mask[i] and finite and math.isfinite(x1[i, 0]) and math.isfinite(x1[i, 1])
    points0, points1 = points[0, :m], points[1, :m]
    members, cost, total, done = np.arange(m), vector(m), np.zeros(m), 0
    for k in range(len(thresholds)):
        if done > 0 and len(members) < neighbors[k] + 4:
            continue
        _cost(points0, points1, members, neighbors[k], taus[k], cost)
        done += 1
        total += cost
        kept = 0
        members = np.empty(m, np.int64)
        for i in range(m):
            members[kept] = i
            kept += cost[i] <= thresholds[k]
        members = members[:kept]
    for i in range(m):
        out[0, match[i]] = cost[i] <= thresholds[done - 1]
        out[1, match[i]] = total[i] / done


@inner
def _cost(points0: Array, points1: Array, members: Array, K: int, tau: float, cost: Array) -> None:
    """The mean over the three neighbourhood sizes -> cost (n,); the neighbours are among the members."""
    n, width = len(points0), K + 3
    near0, near1 = np.empty((n, width), np.int64), np.empty((n, width), np.int64)
    search(points0, points0[members], near0)
    search(points1, points1[members], near1)
    for i in range(n):
        cost[i] = 0
        for scale in range(3):  # as released: neighbours 1..K+2, 2..K+1, 3..K; 0 is the match
            size = K + 2 - 2 * scale
            kept = 0
            for a in range(1 + scale, width - scale):
                place = 0
                for b in range(width):
                    if near0[i, a] == near1[i, b] and near0[i, a] >= 0:
                        place = b
                if scale < place < width - scale:
                    kept += not _differs(points0, points1, i, members[near0[i, a]], tau)
            cost[i] += (size - kept) / size
        cost[i] /= 3


@inner
def _differs(points0: Array, points1: Array, i: int, j: int, tau: float) -> Any:
    """Whether matches i and j move differently; never where one of the two does not move."""
    x, y = points1[i, 0] - points0[i, 0], points1[i, 1] - points0[i, 1]
    u, v = points1[j, 0] - points0[j, 0], points1[j, 1] - points0[j, 1]
    length, other = x * x + y * y, u * u + v * v
    cosine = (x * u + y * v) / math.sqrt(length * other)
    return cosine * min(length, other) / max(length, other) < tau
