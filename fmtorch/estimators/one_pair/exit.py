"""From the outcome of one pair to its estimate in pixels, if its inliers support one. As `estimators.batching`."""

from __future__ import annotations

import math

import numpy as np

from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.support import DIRECTION, EXTENT_ROUNDING, FIRST_LOOK, ROUNDINGS, reason

ALONG = np.array(DIRECTION)[:, None]
IMAGES = np.arange(2)


def lack_of_support(points: Array, inliers: Array, minimal: int, rounding: float) -> str:
    """As `support.lack_of_support`, of points (4, n) and inliers (n,)."""
    lack = _lack(points[:, :FIRST_LOOK], inliers[:FIRST_LOOK], minimal, rounding)
    return _lack(points, inliers, minimal, rounding) if lack and len(inliers) > FIRST_LOOK else lack


def _lack(points: Array, inliers: Array, minimal: int, rounding: float) -> str:
    (index,) = inliers.nonzero()
    if not len(index):
        return reason(0, [], minimal)
    some = points.take(index, 1)
    a, b, c, d = some * ALONG
    ordered = np.sort(a + b + c + d)
    different = 1 + int(np.count_nonzero(ordered[1:] != ordered[:-1]))
    return reason(different, [] if different < minimal else _on_line(some.reshape(2, 2, -1), rounding), minimal)


def _on_line(points: Array, rounding: float) -> list[bool]:
    """As `support._collinear`, of the points (2, 2, n) of both images."""
    dx, dy = (points - points[:, :, :1]).swapaxes(0, 1)
    squared = dx * dx + dy * dy
    far = squared.argmax(1)
    ux, uy, extent = dx[IMAGES, far], dy[IMAGES, far], np.sqrt(squared[IMAGES, far])
    across = np.abs(dx * uy[:, None] - dy * ux[:, None]).max(1)
    on_line: list[bool] = (across <= np.maximum(ROUNDINGS * rounding, EXTENT_ROUNDING * extent) * extent).tolist()
    return on_line


def rounding_of(pair: OnePair, relative: float) -> float:
    """How exact the coordinates of a pair are, in the unit of its points; relative: of a number of 1."""
    return float(np.abs(pair.centre).max() / pair.pixels_per_unit + 1) * relative


def to_pixels(F: Array, pair: OnePair) -> Array:
    """As `NormalizedPairs.to_pixels`, of one matrix."""
    T0, T1 = (_from_pixels(pair, first) for first in (0, 2))
    F = _product(_product(T1.T, F), T0)
    entries = F.ravel().tolist()
    largest = max(entries, key=abs)
    F = F / (abs(largest) or 1.0)
    squared = 0.0
    for entry in F.ravel().tolist():
        squared += entry * entry
    return F * (1 / math.sqrt(squared) if squared else 0.0) * math.copysign(1.0, largest)


def _from_pixels(pair: OnePair, first: int) -> Array:
    """As `PixelFrame._from_pixels`."""
    x, y = pair.centre[first : first + 2].tolist()
    unit = pair.pixels_per_unit
    return np.array([[1 / unit, 0, -x / unit], [0, 1 / unit, -y / unit], [0, 0, 1]])


def _product(a: Array, b: Array) -> Array:
    """As `arithmetic.matmul3`."""
    found: Array = a[:, :1] * b[:1] + a[:, 1:2] * b[1:2] + a[:, 2:] * b[2:]
    return found
