"""`irls` for the matches of one pair, compiled; float64."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import kernel
from fmtorch.compiling.lanes import LANES, load, store
from fmtorch.geometry.eight_point_kernels import weighted_eight_point
from fmtorch.geometry.rank2_kernels import assign
from fmtorch.geometry.sampson_objective_kernels import MATCH, in_rows, linearise, robust

Array = NDArray[Any]


@kernel("f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], i8, f8[:, ::1]")
def reweighted(F: Array, points: Array, weight: Array, s2: Array, loss: int, table: Array) -> None:
    """`irls.reweighted` of models (k, 9), in place, points (4, n) and weights (n,); the rest as of `evaluate`."""
    matches, J, work = in_rows(points, weight, s2), np.empty((10, LANES)), np.empty((3, LANES))
    weights, fitted = np.empty((len(matches) // MATCH, LANES)), np.empty(9)
    for k in range(len(F)):
        for row in range(0, len(matches), MATCH):
            inverse, r2 = linearise(F[k], matches, row, J)
            _, slope = robust(r2, load(matches, row + 5), loss, table, work)
            store(weights, row // MATCH, inverse * (load(matches, row + 4) * slope))
        if weighted_eight_point(points, weights.ravel()[: len(weight)], fitted):
            assign(F[k], fitted)
