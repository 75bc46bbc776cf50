"""A round's models scored on few matches, the best of these on all, compiled: one call for both.

F: (m, 9) float32. which: (k,), room for the models that are scored on all matches, k = m for all of them; the best k on
the matches of the first look -> which, ascending, and their scores -> score (k,). What scores take of the matches is
told in `scores_kernels`, first of the first look, then of all.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner, kernel
from fmtorch.estimators.pool_kernels import best
from fmtorch.estimators.scores_kernels import score_gains, score_saturated

Array = NDArray[Any]
FIRST_LOOK = "f4[:, ::1], f4[:, ::1], f4[::1], f4[::1], i8, i8, f4[::1]"


@kernel(FIRST_LOOK + ", f4[:, ::1], f4[::1], f4[::1], i8, i8[::1], f8[::1]")
def verify_by_gains(
    F: Array, few: Array, few_support: Array, few_scale: Array, few_bits: int, gain: int, table: Array, points: Array,
    support: Array, scale: Array, bits: int, which: Array, score: Array,
) -> None:  # fmt: skip
    """By `score_gains` both times."""
    _first_look(F, few, few_support, few_scale, few_bits, gain, table, which)
    score_gains(F, which, points, support, scale, gain, table, bits, score)


@kernel(FIRST_LOOK + ", f4[:, ::1], f4[::1], f4[::1], i4[:, ::1], i8, i8[::1], f8[::1]")
def verify_by_saturated_gains(
    F: Array, few: Array, few_support: Array, few_scale: Array, few_bits: int, gain: int, table: Array, points: Array,
    support: Array, scale: Array, cells: Array, bits: int, which: Array, score: Array,
) -> None:  # fmt: skip
    """By `score_gains` first, then by `score_saturated`."""
    _first_look(F, few, few_support, few_scale, few_bits, gain, table, which)
    score_saturated(F, which, points, support, scale, cells, bits, score)


@inner
def _first_look(
    F: Array, points: Array, support: Array, scale: Array, bits: int, gain: int, table: Array, which: Array
) -> None:  # fmt: skip
    if len(which) == len(F):
        for k in range(len(F)):
            which[k] = k
        return
    every, score = np.arange(len(F)), np.empty(len(F))
    score_gains(F, every, points, support, scale, gain, table, bits, score)
    best(score, which)
