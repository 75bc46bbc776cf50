"""Pinhole cameras, and what two of them say about an image pair.

Pixels (x, y) with (0, 0) at the centre of the first pixel; ``x ~ K (R X + t)``; camera axes x right, y down, z forward.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.text_files import DataError

Matrix = NDArray[np.float64]

SAME_CENTRE = 1e-9  # baseline below which there is no F, relative to the cameras' distance from the origin (float64)
NEARLY_ROTATION = 0.05  # change of an entry up to which a matrix is taken for a rotation that was rounded


@runtime_checkable
class Pinhole(Protocol):
    """Anything with a calibration K (3, 3), and R (3, 3), t (3,) that map the world to the camera."""

    @property
    def K(self) -> Matrix: ...

    @property
    def R(self) -> Matrix: ...

    @property
    def t(self) -> Matrix: ...


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A camera and nothing else."""

    K: Matrix
    R: Matrix
    t: Matrix


def relative_pose(camera0: Pinhole, camera1: Pinhole) -> tuple[Matrix, Matrix]:
    """R and t of ``X1 = R X0 + t``, with X0 and X1 in the two cameras' coordinates."""
    R = camera1.R @ camera0.R.T
    return R, camera1.t - R @ camera0.t


def fundamental(camera0: Pinhole, camera1: Pinhole) -> Matrix:
    """F with ``x1^T F x0 = 0`` and unit Frobenius norm: ``K1^-T [t]x R K0^-1`` (Hartley and Zisserman, eq. 9.12).

    Equal, up to scale, to ``[P1 C0]x P1 P0^+`` of the projection matrices. NaN where the baseline is exactly zero.
    """
    R, t = relative_pose(camera0, camera1)
    cross = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    F: Matrix = np.linalg.inv(camera1.K).T @ cross @ R @ np.linalg.inv(camera0.K)
    return F / np.linalg.norm(F)


def share_centre(camera0: Pinhole, camera1: Pinhole) -> bool:
    """Whether two cameras are at one place, as far as float64 tells: a pure rotation has no F."""
    centres = [-camera.R.T @ camera.t for camera in (camera0, camera1)]
    return bool(np.linalg.norm(centres[0] - centres[1]) <= SAME_CENTRE * max(map(np.linalg.norm, centres)))


def from_projection(P: Matrix, R: Matrix, t: Matrix) -> Camera:
    """The camera ``P [R | t; 0 1]``, of a projection (3, 4) of an already rectified camera: ``P = K [I | K^-1 p4]``."""
    K = P[:, :3]
    return Camera(K, R, t + np.linalg.solve(K, P[:, 3]))


def nearest_rotation(matrix: Matrix, place: str) -> Matrix:
    """The rotation nearest to a matrix (3, 3) that was one before it was rounded to a text file.

    Raises DataError, which begins with `place`, for a matrix that is no rotation.
    """
    u, _, v = np.linalg.svd(matrix)
    rotation: Matrix = u @ v
    if np.linalg.det(rotation) < 0 or np.abs(rotation - matrix).max() > NEARLY_ROTATION:
        raise DataError(f"{place}: the matrix is no rotation; it must be orthonormal with determinant 1")
    return rotation


def rotation_of_quaternion(quaternion: Matrix, place: str) -> Matrix:
    """The rotation of a quaternion (w, x, y, z) of any length. Raises DataError, after `place`, where that is zero."""
    norm = np.linalg.norm(quaternion)
    if not np.isfinite(norm) or norm == 0:
        raise DataError(f"{place}: quaternion {quaternion.tolist()}; it must be finite and not zero")
    w, x, y, z = quaternion / norm
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
