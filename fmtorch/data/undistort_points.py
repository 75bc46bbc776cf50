"""Points and local affine frames of photographs as a pinhole of the same K would have them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.lenses import MODELS, Lens

Array = NDArray[np.float64]

ITERATIONS = 50  # at most; most points take four
STEP = 1e-6  # of the derivatives, in units of the focal length
TOLERANCE = 1e-10  # of distorted points, likewise: 1e-7 px at a focal length of 1000 px
RAY = np.linspace(0.0, 1.0, 33)  # where, from the centre to a point, a lens must lead outwards
FRAME_STEP = 0.5  # px: a frame's columns are moved by the lens as short steps of that length


def undistorted_points(lens: Lens, photographed: NDArray[np.floating[Any]]) -> Array:
    """Pixels (..., 2) of a pinhole of calibration `lens.K` for those of the photograph; NaN where it sees nothing.

    The inverse of `Lens.distort` by Newton's method. NaN too where the model folds back between centre and point: there
    a polynomial has left the range to which it was fitted, as `undistorted` leaves such pixels black.
    """
    points: Array = np.array(photographed, np.float64)
    if not lens.bends:
        return points
    centre, focal = np.array([lens.cx, lens.cy]), np.array([lens.fx, lens.fy])
    target = (points.reshape(-1, 2) - centre) / focal
    with np.errstate(all="ignore"):
        x = _inverted(lens, target)
    return np.asarray(x * focal + centre, np.float64).reshape(points.shape)


def undistorted_frames(
    undistorted: Callable[[Array], Array], photographed: NDArray[np.floating[Any]], frames: NDArray[np.floating[Any]]
) -> Array:
    """Local affine frames (n, 2, 2), by columns, of a pinhole's image, by the lens's derivatives at points (n, 2)."""
    points: Array = np.array(photographed, np.float64)
    there = undistorted(points)
    moved = [undistorted(points + step) - there for step in FRAME_STEP * np.eye(2)]
    return np.asarray(np.stack(moved, -1) / FRAME_STEP @ frames, np.float64)


def _inverted(lens: Lens, target: Array) -> Array:
    """Normalised points (n, 2) that the lens puts at the target (n, 2)."""
    model = MODELS[lens.model]

    def distort(x: Array) -> Array:
        return np.stack(model.distort(x[..., 0], x[..., 1], *lens.coefficients), -1)

    x = target.copy()
    if model.fisheye:  # whose radius is about the angle to the axis
        angle = np.hypot(target[:, 0], target[:, 1])
        x = np.where((angle > 0)[:, None], target * (np.tan(angle) / angle)[:, None], target)
        x = np.where((angle < np.pi / 2)[:, None], x, target)
    error = distort(x) - target
    for _ in range(ITERATIONS):
        size = np.hypot(error[:, 0], error[:, 1])
        if not (size > TOLERANCE).any():
            break
        move = _solved(_jacobian(distort, x), error)
        for share in (1.0, 0.25, 0.0625):  # shorter where the error would grow
            trial = x - share * move
            left = distort(trial) - target
            better = (np.hypot(left[:, 0], left[:, 1]) < size)[:, None]
            x, error = np.where(better, trial, x), np.where(better, left, error)
            move = np.where(better, 0.0, move)
    along = distort(RAY[:, None, None] * x)  # from the centre outwards
    outwards = (np.diff(along, axis=0) * x).sum(-1) > 0
    valid = (np.hypot(error[:, 0], error[:, 1]) <= TOLERANCE) & (outwards.all(0) | ~x.any(1))
    return np.where(valid[:, None], x, np.nan)


def _jacobian(distort: Callable[[Array], Array], x: Array) -> Array:
    """The derivatives (n, 2, 2) of the distorted point, by columns."""
    return np.stack([(distort(x + step) - distort(x - step)) / (2 * STEP) for step in STEP * np.eye(2)], -1)


def _solved(J: Array, b: Array) -> Array:
    """J^-1 b of matrices (n, 2, 2) and vectors (n, 2)."""
    det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    x = J[:, 1, 1] * b[:, 0] - J[:, 0, 1] * b[:, 1]
    y = J[:, 0, 0] * b[:, 1] - J[:, 1, 0] * b[:, 0]
    return np.stack([x, y], -1) / det[:, None]
