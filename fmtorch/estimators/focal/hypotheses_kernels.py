"""Hypotheses of five matches and drawn focal lengths for one pair, compiled: those of `hypotheses`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import kernel
from fmtorch.compiling.random_kernels import random_bits, stream_state
from fmtorch.estimators.sampling_kernels import draw_from
from fmtorch.geometry.arithmetic_kernels import exponential
from fmtorch.geometry.five_point_kernels import five_point

Array = NDArray[Any]
SOLUTIONS = 10  # of five matches, at most


@kernel(
    "i8[::1], i8[::1], i8[::1], i8[::1], f8[::1], f8[::1], b1, f8[::1], i8, i8, i8, i8, f8[:, ::1], f8[::1], "
    "i8[:, ::1], f4[:, ::1], i8[::1]"
)
def samples_of_five(
    table: Array, totals: Array, newest: Array, order: Array, normal: Array, numbers: Array, same_size: bool,
    longest: Array, sampling_seed: int, focal_seed: int, key: int, start: int, points: Array, offset: Array,
    sample: Array, F: Array, draw: Array,
) -> int:  # fmt: skip
    """Samples drawn and solved in one call: as `solvers_kernels`, with the focal lengths of `draw_depths`.

    points: (4, n), from the principal points. offset: (4,), what was added to them.
    """
    depth = np.empty((2, sample.shape[1]))
    draw_from(table, totals, newest, order, sampling_seed, key, start, sample)
    draw_depths(normal, numbers, same_size, longest, focal_seed, key, start, depth)
    return five_point(points, sample, depth, offset, F, draw)


@kernel("f8[::1], f8[::1], b1, f8[::1], i8, i8, i8, f8[:, ::1]", brief=True)
def draw_depths(
    normal: Array, numbers: Array, same_size: bool, longest: Array, mixed_seed: int, key: int, start: int, out: Array
) -> None:  # fmt: skip
    """Those of `prior.draw_focal_lengths`: of draws start, start + 1, ... in the unit of the points -> out (2, count).

    normal: (2^k,), quantiles of the normal distribution. numbers: mean and deviation of the mean logarithm, half the
    deviation of the logarithm of the ratio, share of draws of one focal length where the images have the same size.
    longest: (2,), the longer sides of the images. mixed_seed: of the seed and the stream.
    """
    state, mask = stream_state(mixed_seed, key), np.uint64(len(normal) - 1)
    for d in range(out.shape[1]):
        first = (start + d) * 3
        mean = numbers[0] + numbers[1] * normal[random_bits(state, first) & mask]
        half = numbers[2] * normal[random_bits(state, first + 1) & mask]
        if same_size and np.int64(random_bits(state, first + 2) & mask) < numbers[3] * len(normal):
            half = 0.0
        out[0, d], out[1, d] = exponential(mean + half) * longest[0], exponential(mean - half) * longest[1]
