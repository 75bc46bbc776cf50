"""The matches of a pair as scores take them: in rows of float32 numbers, with the scale and the weight of each."""

from __future__ import annotations

import numpy as np

from fmtorch.compiling.arrays import Array, F4x2, F8x2
from fmtorch.compiling.kernel import kernel
from fmtorch.estimators.pair import Pair
from fmtorch.geometry.residual_kernels import MATCH, SINGLES


def fractional_bits(count: int) -> int:
    """Of so many float32 numbers in [0, 1], for their sums to be exact: 10, fewer beyond 2^14 numbers."""
    return min(10, 24 - (count - 1).bit_length())


def scored_matches(pair: Pair, threshold: float, prior_weighted: bool) -> Array:
    """The matches as kernels take them, for residuals in thresholds: (rows, SINGLES) float32."""
    rows = np.empty((rows_of(pair.count), SINGLES), np.float32)
    pack(pair.table, threshold, prior_weighted, rows)
    return rows


def rows_of(count: int) -> int:
    """Rows of so many matches: MATCH for each SINGLES of them."""
    return (count + SINGLES - 1) // SINGLES * MATCH


@kernel(holds_gil=True)
def pack(table: F8x2, threshold: float, weighted: bool, rows: F4x2) -> None:
    """SINGLES matches in MATCH rows each -> rows; those that fill the last ones have no weight.

    table: (9, n), of `Pair`. weighted: by the prior. The scale of a match is one over the square of its threshold.
    """
    n = table.shape[1]
    for first in range(0, n, SINGLES):
        row = first // SINGLES * MATCH
        for i in range(SINGLES):
            for k in range(4):
                rows[row + k, i] = table[k, first + i] if first + i < n else 0.0
            scale = table[5, first + i] / threshold if first + i < n else 0.0
            rows[row + 4, i] = scale * scale
            weight = table[6, first + i] if weighted and first + i < n else 1.0
            rows[row + 5, i] = weight if first + i < n else 0.0
