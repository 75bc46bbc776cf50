"""Exact pinhole cameras with the size of their images."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.cameras import fundamental, relative_pose
from fmtorch.scenes.textures import Real

__all__ = ["Camera", "Matrix", "calibration", "fundamental", "look_at", "relative_pose"]

Matrix = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole: ``x ~ K (R X + t)``, pixels (x, y) with (0, 0) at the centre of the first pixel; size (h, w).

    World units are metres with z upwards; camera axes are OpenCV's (x right, y down, z forward).
    """

    K: Matrix
    R: Matrix
    t: Matrix
    size: tuple[int, int]

    @property
    def centre(self) -> Matrix:
        """The centre of projection in the world, (3,)."""
        return -self.R.T @ self.t

    @property
    def P(self) -> Matrix:
        """The projection matrix K [R | t], (3, 4)."""
        return self.K @ np.column_stack([self.R, self.t])

    def project(self, X: Matrix) -> tuple[Matrix, Matrix]:
        """World points (n, 3) to pixels (n, 2) and depths (n,)."""
        x = (X @ self.R.T + self.t) @ self.K.T
        return x[:, :2] / x[:, 2:], x[:, 2]


def calibration(focal: Real, size: tuple[int, int], centre: tuple[float, float] | None = None) -> Matrix:
    """K of square pixels: focal length in pixels, principal point (x, y), by default the middle of the image."""
    h, w = size
    cx, cy = centre if centre is not None else ((w - 1) / 2, (h - 1) / 2)
    return np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])


def look_at(
    K: Matrix, size: tuple[int, int], centre: Sequence[Real], target: Sequence[Real], roll: Real = 0.0
) -> Camera:
    """A camera at `centre` that looks at `target`, upright but for a roll about its axis in radians."""
    c = np.asarray(centre, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - c
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cos, sin = np.cos(roll), np.sin(roll)
    R = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    return Camera(K, R, -R @ c, size)
