"""Photographs as a pinhole of the same focal lengths and principal point would have taken them."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.data.lenses import Lens

_KEPT = 2  # maps of which lenses are remembered: frames of one video follow one another; 8 bytes a pixel


def undistorted(image: NDArray[np.uint8], lens: Lens) -> NDArray[np.uint8]:
    """The image (H, W) or (H, W, 3) without the distortion of its lens: same size, and `lens.K` is its calibration.

    Interpolated bilinearly. Black where the photograph shows nothing, and where a polynomial model folds back.
    """
    if not lens.bends:
        return image
    x, y = _maps(lens, *image.shape[:2])
    return cv2.remap(image, x, y, cv2.INTER_LINEAR)  # type: ignore[return-value]


@functools.lru_cache(maxsize=_KEPT)
def _maps(lens: Lens, h: int, w: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """For every pixel (h, w) of the undistorted image where in the photograph it is; -2, which is outside, if nowhere.

    Where a step outwards no longer leads outwards, a polynomial has left the range to which it was fitted: nothing is
    taken from there on.
    """
    grid = np.stack(np.meshgrid(np.arange(w, dtype=np.float64), np.arange(h, dtype=np.float64)), -1)
    there = lens.distort(grid)
    dx, dy = grid[..., 0] - lens.cx, grid[..., 1] - lens.cy
    if min(h, w) > 1:
        (x_y, x_x), (y_y, y_x) = np.gradient(there[..., 0]), np.gradient(there[..., 1])
        outwards = (x_x * dx + x_y * dy) * dx + (y_x * dx + y_y * dy) * dy
        radius = np.hypot(dx / lens.fx, dy / lens.fy)
        folded = ~(outwards > 0) & (radius > 0)
        there[radius >= np.min(radius[folded], initial=np.inf)] = -2
    x, y = np.ascontiguousarray(np.moveaxis(np.nan_to_num(there, nan=-2.0), -1, 0).astype(np.float32))
    return x, y
