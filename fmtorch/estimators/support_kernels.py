"""`support` for the inliers of one pair, compiled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner, kernel

Array = NDArray[Any]
ROUNDINGS, EXTENT_ROUNDING = 4.0, 2.0**-23  # as in `support`
DIRECTION = (0.3819660112501051, 0.7236067977499790, 0.8541019662496845, 0.5278640450004206)


@kernel("f8[:, ::1], b1[::1], i8, i8, f8, b1[::1]", brief=True)
def support(points: Array, inliers: Array, first: int, minimal: int, rounding: float, on_line: Array) -> int:
    """How many different ones the inliers (n,) among the first points (4, n) are, counted up to `minimal`.

    on_line: (2,), whether they lie on one line in each image. rounding: of coordinates, in the unit of the points.
    """
    index, count = np.empty(first, np.int64), 0
    for i in range(first):
        index[count] = i
        count += inliers[i]
    places, different = np.empty(minimal), 0
    for i in range(count):
        if different == minimal:
            break
        k, place = index[i], 0.0
        place = points[0, k] * DIRECTION[0] + points[1, k] * DIRECTION[1]
        place = place + points[2, k] * DIRECTION[2] + points[3, k] * DIRECTION[3]
        new = True
        for j in range(different):
            new = new and places[j] != place
        if new:
            places[different] = place
            different += 1
    on_line[0] = count > 0 and _on_line(points[0], points[1], index, count, rounding)
    on_line[1] = count > 0 and _on_line(points[2], points[3], index, count, rounding)
    return different


@inner
def _on_line(x: Array, y: Array, index: Array, count: int, rounding: float) -> bool:
    """As `support._collinear`: the line through the first point and the one farthest from it."""
    ux, uy, longest, across = 0.0, 0.0, -1.0, 0.0
    for i in range(count):
        dx, dy = x[index[i]] - x[index[0]], y[index[i]] - y[index[0]]
        squared = dx * dx + dy * dy
        if squared > longest:
            ux, uy, longest = dx, dy, squared
    for i in range(count):
        dx, dy = x[index[i]] - x[index[0]], y[index[i]] - y[index[0]]
        across = max(across, abs(dx * uy - dy * ux))
    extent = math.sqrt(longest)
    return across <= max(ROUNDINGS * rounding, EXTENT_ROUNDING * extent) * extent
