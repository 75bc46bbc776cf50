"""`graph_cut` for one model, compiled: the eight-point algorithm on its inliers and on samples of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import kernel
from fmtorch.compiling.random_kernels import random_bits, stream_state
from fmtorch.geometry.eight_point_kernels import weighted_eight_point

Array = NDArray[Any]


@kernel("f8[:, ::1], b1[::1], i8, i8, i8, i8, f8[:, ::1]")
def fits(points: Array, labels: Array, mixed_seed: int, key: int, draw: int, size: int, out: Array) -> int:
    """Models of all inliers of points (4, n), and of samples of these -> out (samples + 1, 9); how many there are.

    labels: (n,), the inliers. mixed_seed: of the seed and the stream. draw: the number of the first sample. size:
    matches of a sample, drawn with replacement.
    """
    state = stream_state(mixed_seed, key)
    inliers, total = np.empty(len(labels), np.int64), 0
    for i in range(len(labels)):
        if labels[i]:
            inliers[total] = i
            total += 1
    if total == 0:
        return 0
    models, whole, sample = 0, np.empty((4, total)), np.empty((4, size))
    for i in range(total):
        for k in range(4):
            whole[k, i] = points[k, inliers[i]]
    models += weighted_eight_point(whole, np.ones(total), out[0])
    ones = np.ones(size)
    for s in range(len(out) - 1):
        for j in range(size):
            word = random_bits(state, (draw + s) * size + j) >> np.uint64(31)
            drawn = np.int64(word * np.uint64(total) >> np.uint64(32))
            for k in range(4):
                sample[k, j] = whole[k, drawn]
        models += weighted_eight_point(sample, ones, out[models])
    return models
