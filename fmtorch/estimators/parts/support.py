"""Whether the inliers of a model could determine it: enough of them, and not all on one line."""

from __future__ import annotations

import math

import numpy as np

from fmtorch.compiling.arrays import Array, B1x1, F8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.scratch import vector
from fmtorch.estimators.pair import Pair

ROUNDINGS = 4.0  # of coordinates, that exact points of a line may lie off it
EXTENT_ROUNDING = 2.0**-23  # the same in units of the points' extent: nobody knows pixels better than a float32 holds
FIRST_LOOK = 256  # matches that mostly suffice to see that there is support
DIRECTION = (0.3819660112501051, 0.7236067977499790, 0.8541019662496845, 0.5278640450004206)
"""Along which different matches are told apart; no simple ratios, so that hardly any two project to one number."""


def degenerate_support(pair: Pair, inliers: Array, minimal: int, rounding: float) -> str:
    """Why the inliers (n,) determine no model; empty where they may. Several at one place in both images count once.

    minimal: the size of a minimal sample; fewer inliers support a model no more than any other. rounding: how exact a
    coordinate of 1 is.
    """
    largest: float = max(map(abs, pair.centre.tolist()))
    rounding *= largest / pair.pixels_per_unit + 1  # in the unit of the points
    on_line = np.empty(2, np.bool_)
    for first in (min(FIRST_LOOK, pair.count), pair.count):
        different = support(pair.points, inliers[:first], minimal, rounding, on_line)
        reason = _reason(different, on_line, minimal)
        if not reason:
            break
    return reason


def _reason(count: int, on_line: Array, minimal: int) -> str:
    if count < minimal:
        return f"the best model has {count} different inliers; at least {minimal} are needed"
    if on_line.any():
        images = " and ".join(f"image {i}" for i in (0, 1) if on_line[i])
        return f"the inliers of the best model lie on one line in {images}"
    return ""


@kernel(holds_gil=True)
def support(points: F8x2, inliers: B1x1, minimal: int, rounding: float, on_line: B1x1) -> int:
    """How many different ones the inliers (m,) among the first m points (4, n) are, counted up to `minimal`.

    on_line: (2,), whether they lie on one line in each image. rounding: of coordinates, in the unit of the points.
    """
    index, count = np.empty(len(inliers), np.int64), 0
    for i in range(len(inliers)):
        index[count] = i
        count += inliers[i]
    places, different = vector(minimal), 0
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
    """Whether points lie on one line, up to rounding: that through the first one and the one farthest from it."""
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
