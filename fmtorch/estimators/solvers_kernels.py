"""Minimal samples of one pair drawn and solved in one call, compiled, so that Python's lock is given up once.

table, totals, newest, order: of `one_pair.sampling.Urn`. mixed_seed: of the seed and the stream. points: (4, n). The
matches of draws start, start + 1, ... -> sample (size, count), the models of these -> F (m, 9), m is returned, and the
draw that each is made of, counted from `start` -> draw (m,).
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fmtorch.compiling.kernel import kernel
from fmtorch.estimators.sampling_kernels import draw_from
from fmtorch.geometry.eight_point_kernels import eight_point
from fmtorch.geometry.seven_point_kernels import seven_point

Array = NDArray[Any]
SAMPLES = "i8[::1], i8[::1], i8[::1], i8[::1], i8, i8, i8, f8[:, ::1], i8[:, ::1], f4[:, ::1], i8[::1]"


@kernel(SAMPLES)
def samples_of_seven(
    table: Array, totals: Array, newest: Array, order: Array, mixed_seed: int, key: int, start: int, points: Array,
    sample: Array, F: Array, draw: Array,
) -> int:  # fmt: skip
    """Models by the seven-point algorithm."""
    draw_from(table, totals, newest, order, mixed_seed, key, start, sample)
    return seven_point(points, sample, F, draw)


@kernel(SAMPLES)
def samples_of_eight(
    table: Array, totals: Array, newest: Array, order: Array, mixed_seed: int, key: int, start: int, points: Array,
    sample: Array, F: Array, draw: Array,
) -> int:  # fmt: skip
    """Models by the eight-point algorithm."""
    draw_from(table, totals, newest, order, mixed_seed, key, start, sample)
    return eight_point(points, sample, F, draw)
