"""`irls` for the matches of one pair, compiled; float64."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.geometry.eight_point_kernels import weighted_eight_point
from fmtorch.geometry.rank2_kernels import assign
from fmtorch.geometry.sampson_objective_kernels import INVERSE, ROWS, WIDTH, linearise, robust
from fmtorch.kernels import kernel

Array = NDArray[Any]


@kernel("f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], i8, f8[:, ::1]")
def reweighted(F: Array, points: Array, weight: Array, s2: Array, loss: int, table: Array) -> None:
    """`irls.reweighted` of models (k, 9), in place, points (4, n) and weights (n,); the rest as of `evaluate`."""
    n, block = len(weight), np.empty((ROWS, WIDTH))
    weights, fitted = np.empty(n), np.empty(9)
    for k in range(len(F)):
        for first in range(0, n, WIDTH):
            linearise(F[k], points, weight, s2, first, block)
            robust(block, loss, table)
            for i in range(min(WIDTH, n - first)):
                weights[first + i] = block[INVERSE, i]
        if weighted_eight_point(points, weights, fitted):
            assign(F[k], fitted)
