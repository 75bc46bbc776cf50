"""LMedS: the median residual as a score."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from fmtorch.compiling.arrays import Array, F4x2, F8x1, I8x1
from fmtorch.compiling.kernel import Kernel, inner, kernel
from fmtorch.compiling.lanes import store
from fmtorch.estimators.pair import Pair
from fmtorch.estimators.parts.scored_matches import rows_of
from fmtorch.geometry.order_kernels import smallest_but
from fmtorch.geometry.residual_kernels import MATCH, SINGLES, Residual

BIN_SHIFT, BINS = 21, 1 << 10  # of a float32 the exponent and two bits more


class Median:
    """LMedS: minus the median squared residual, of an even number the lower middle one (Rousseeuw 1984)."""

    prior_weighted = False

    def __call__(self, F: Array, which: Array, pair: Pair) -> Array:
        """As `Score`."""
        out = np.empty(len(which))
        score_median_of(pair.residual)(F, which, pair.cached("rows of ones", _rows), pair.count, out)
        return out


def _rows(pair: Pair) -> Array:
    """The matches in rows, of scale and weight one."""
    rows = np.zeros((rows_of(pair.count), SINGLES), np.float32)
    pack_points(pair.points32, rows)
    return rows


@kernel(holds_gil=True)
def pack_points(points: F4x2, rows: F4x2) -> None:
    """Points (4, n) as the rows of `scores.pack`, of scale and weight one; rows of zeros come in."""
    for i in range(points.shape[1]):
        row, lane = i // SINGLES * MATCH, i % SINGLES
        for k in range(4):
            rows[row + k, lane] = points[k, i]
        rows[row + 4, lane], rows[row + 5, lane] = 1.0, 1.0


@functools.cache
def score_median_of(residual: Residual) -> Kernel[..., None]:
    """The kernel of medians for a residual."""
    of_row = residual.of_row

    @kernel(name=f"score_median_{residual.name}")
    def score_median(F: F4x2, which: I8x1, rows: F4x2, count: int, out: F8x1) -> None:
        """Minus the median squared residual of so many matches under the models F[which] -> out (k,)."""
        values = np.empty(count + 1, np.float32)
        r2, counts = np.empty((len(rows) // MATCH, SINGLES), np.float32), np.empty(BINS, np.int32)
        for k in range(len(which)):
            for row in range(0, len(rows), MATCH):
                store(r2, row // MATCH, of_row(F[which[k]], rows, row))
            out[k] = -_smallest(r2.ravel()[:count], counts, values, (count + 1) // 2)

    return score_median


@inner
def _smallest(values: Array, counts: Array, of_bin: Array, rank: int) -> Any:
    """The value of a rank, from 1, in ascending order, of numbers that are not negative; NaN counts as infinite.

    counts: (BINS,), of_bin: (n + 1,), for the work. First the bin of the value is found, by its upper bits.
    """
    for i in range(len(values)):
        values[i] = values[i] if values[i] == values[i] else np.float32(math.inf)
    bits = values.view(np.int32)
    for b in range(BINS):
        counts[b] = 0
    for i in range(len(values)):
        counts[bits[i] >> BIN_SHIFT] += 1
    wanted, left = 0, rank
    while counts[wanted] < left:
        left -= counts[wanted]
        wanted += 1
    m = 0
    for i in range(len(values)):
        of_bin[m] = values[i]
        m += (bits[i] >> BIN_SHIFT) == wanted
    return smallest_but(of_bin, 0, m, left - 1)
