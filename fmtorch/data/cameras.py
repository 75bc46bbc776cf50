"""Pinhole cameras, what two of them say about an image pair, and photographs without the distortion of lenses."""

import dataclasses
import functools

import cv2
import numpy as np

from fmtorch.core.lenses import Lens
from fmtorch.data.files import DataError, Matrix, Pixels, Singles

SAME_CENTRE = 1e-9  # baseline below which there is no F, relative to the cameras' distance from the origin (float64)
NEARLY_ROTATION = 0.05  # change of an entry up to which a matrix is taken for a rotation that was rounded


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole: its calibration K (3, 3), and R (3, 3), t (3,) that map the world to the camera."""

    K: Matrix
    R: Matrix
    t: Matrix


def relative_pose(camera0: Camera, camera1: Camera) -> tuple[Matrix, Matrix]:
    """R and t of ``X1 = R X0 + t``, with X0 and X1 in the two cameras' coordinates."""
    R = camera1.R @ camera0.R.T
    return R, camera1.t - R @ camera0.t


def fundamental(camera0: Camera, camera1: Camera) -> Matrix:
    """F with ``x1^T F x0 = 0`` and unit Frobenius norm: ``K1^-T [t]x R K0^-1`` (Hartley and Zisserman, eq. 9.12).
    Equal, up to scale, to ``[P1 C0]x P1 P0^+`` of the projection matrices. NaN where the baseline is exactly zero."""
    R, t = relative_pose(camera0, camera1)
    cross = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    F: Matrix = np.linalg.inv(camera1.K).T @ cross @ R @ np.linalg.inv(camera0.K)
    return F / np.linalg.norm(F)


def share_centre(camera0: Camera, camera1: Camera) -> bool:
    """Whether two cameras are at one place, as far as float64 tells: a pure rotation has no F."""
    centres = [-camera.R.T @ camera.t for camera in (camera0, camera1)]
    return bool(np.linalg.norm(centres[0] - centres[1]) <= SAME_CENTRE * max(map(np.linalg.norm, centres)))


def line_distance(F: Matrix, x0: Matrix, x1: Matrix) -> Matrix:
    """The larger distance (n,), px, of two matched points (n, 2) to their epipolar lines; infinite on an epipole."""
    h0, h1 = (np.column_stack([x, np.ones(len(x))]) for x in (x0, x1))
    line1, line0 = h0 @ F.T, h1 @ F
    shorter = np.minimum(np.hypot(line0[:, 0], line0[:, 1]), np.hypot(line1[:, 0], line1[:, 1]))
    residual = np.abs((h1 * line1).sum(1))
    return np.where(shorter > 0, residual / np.where(shorter > 0, shorter, 1.0), np.inf)


def nearest_rotation(matrix: Matrix, place: str) -> Matrix:
    """The rotation nearest to a matrix (3, 3) that was one before it was rounded to a text file.
    Raises DataError, which begins with `place`, for a matrix that is no rotation."""
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


# Photographs without the distortion of their lenses

_KEPT = 2  # maps of which lenses are remembered: frames of one video follow one another; 8 bytes a pixel


def undistorted(image: Pixels, lens: Lens) -> Pixels:
    """The image (H, W) or (H, W, 3) without the distortion of its lens: same size, and `lens.K` is its calibration.
    Interpolated bilinearly. Black where the photograph shows nothing, and where a polynomial model folds back."""
    if not lens.bends:
        return image
    x, y = _maps(lens, *image.shape[:2])
    return cv2.remap(image, x, y, cv2.INTER_LINEAR)  # type: ignore[return-value]


@functools.lru_cache(maxsize=_KEPT)
def _maps(lens: Lens, h: int, w: int) -> tuple[Singles, Singles]:
    """For every pixel (h, w) of the undistorted image where in the photograph it is; -2, which is outside, if nowhere.
    Where a step outwards no longer leads outwards, a polynomial has left its range: nothing is taken from there on."""
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
