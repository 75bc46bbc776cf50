"""`one_to_one` for one pair, compiled: the same matches, in linear time by a hash table of locations."""

from __future__ import annotations

import math

import numpy as np

from fmtorch.compiling.arrays import Array, B1x1, F8x1, F8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.random_kernels import mix
from fmtorch.compiling.scratch import vector


@kernel
def one_to_one(x0: F8x2, x1: F8x2, quality: F8x1, mask: B1x1, out: B1x1) -> None:
    """`one_to_one` of x0, x1 (n, 2), quality, mask (n,) -> out (n,)."""
    n = len(mask)
    valid, rank = np.empty(n, np.bool_), vector(n)
    for i in range(n):
        finite = math.isfinite(x0[i, 0]) and math.isfinite(x0[i, 1])
        valid[i] = mask[i] and finite and math.isfinite(x1[i, 0]) and math.isfinite(x1[i, 1])
        rank[i] = math.inf if math.isnan(quality[i]) else quality[i]
        out[i] = valid[i]
    _drop_all_but_the_best(x0, rank, valid, out)
    _drop_all_but_the_best(x1, rank, valid, out)


@inner
def _drop_all_but_the_best(x: Array, rank: Array, valid: Array, out: Array) -> None:
    """Sets out[i] to False where another valid match at the same location has a lower (rank, index)."""
    n = len(valid)
    size = 4
    while size < 2 * n:
        size *= 2
    place, best = np.empty(n, np.int64), np.full(size, -1, np.int64)
    at = x + 0.0  # -0 becomes 0
    bits = at.view(np.uint64)
    for i in range(n):
        if not valid[i]:
            continue
        slot = np.int64(mix(bits[i, 0] + np.uint64(0x9E3779B97F4A7C15) * mix(bits[i, 1])) & np.uint64(size - 1))
        while best[slot] >= 0 and (at[best[slot], 0] != at[i, 0] or at[best[slot], 1] != at[i, 1]):
            slot = (slot + 1) & (size - 1)
        place[i] = slot
        if best[slot] < 0 or rank[i] < rank[best[slot]]:
            best[slot] = i
    for i in range(n):
        if valid[i] and best[place[i]] != i:
            out[i] = False
