"""Pinhole cameras, what two of them say about an image pair, and lenses that distort their images."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from fmtorch.data.files import Array, DataError, Matrix, Pixels, Singles

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
    Equal, up to scale, to ``[P1 C0]x P1 P0^+`` of the projection matrices. NaN where the baseline is exactly zero."""
    R, t = relative_pose(camera0, camera1)
    cross = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    F: Matrix = np.linalg.inv(camera1.K).T @ cross @ R @ np.linalg.inv(camera0.K)
    return F / np.linalg.norm(F)


def share_centre(camera0: Pinhole, camera1: Pinhole) -> bool:
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


# Lens models: where a lens puts what an ideal pinhole would have put elsewhere. All of COLMAP's, by its names

Distortion = Callable[..., tuple[Matrix, Matrix]]

_TINY = 1e-12  # squared radius or parameter below which a quotient is replaced by its limit


@dataclasses.dataclass(frozen=True)
class Lens:
    """A lens: focal lengths and principal point in pixels, with (0, 0) at the centre of the first pixel, and a model.
    coefficients: of the model, as `MODELS` names them, without focal lengths and principal point."""

    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "PINHOLE"
    coefficients: tuple[float, ...] = ()

    @property
    def K(self) -> Matrix:
        """The calibration (3, 3) of the undistorted image."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def bends(self) -> bool:
        """Whether the image differs from a pinhole's."""
        return MODELS[self.model].fisheye or any(self.coefficients)

    def distort(self, points: Matrix) -> Matrix:
        """Where points (..., 2) of the undistorted image are in the photograph, both in pixels."""
        u, v = (points[..., 0] - self.cx) / self.fx, (points[..., 1] - self.cy) / self.fy
        u, v = MODELS[self.model].distort(u, v, *self.coefficients)
        return np.stack([self.fx * u + self.cx, self.fy * v + self.cy], -1)


@dataclasses.dataclass(frozen=True)
class Model:
    """A lens model.
    focals: whether it has one focal length or two. coefficients: names of its parameters after the principal point.
    fisheye: whether it bends even where all of them are zero."""

    focals: int
    coefficients: str
    distort: Distortion
    fisheye: bool = False

    @property
    def parameters(self) -> list[str]:
        """The names of all parameters, in COLMAP's order."""
        return [*(["f"] if self.focals == 1 else ["fx", "fy"]), "cx", "cy", *self.coefficients.split()]

    def lens(self, name: str, values: Matrix) -> Lens:
        """The lens of a model's parameters, whose principal point has the origin of the lens."""
        fx, fy = (values[0], values[0]) if self.focals == 1 else (values[0], values[1])
        cx, cy = values[self.focals : self.focals + 2]
        return Lens(float(fx), float(fy), float(cx), float(cy), name, tuple(map(float, values[self.focals + 2 :])))


def radial(u: Matrix, v: Matrix, k1: float = 0.0, k2: float = 0.0) -> tuple[Matrix, Matrix]:
    """A polynomial in the squared radius; without coefficients, a pinhole."""
    r2 = u * u + v * v
    factor = 1 + r2 * (k1 + r2 * k2)
    return u * factor, v * factor


def rational(
    u: Matrix, v: Matrix,
    k1: float, k2: float, p1: float, p2: float, k3: float = 0.0, k4: float = 0.0, k5: float = 0.0, k6: float = 0.0,
) -> tuple[Matrix, Matrix]:  # fmt: skip
    """A quotient of polynomials, and decentring (Brown): OpenCV's model."""
    r2 = u * u + v * v
    factor = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    du, dv = _decentred(u, v, r2, p1, p2)
    return u * factor + du, v * factor + dv


def field_of_view(u: Matrix, v: Matrix, omega: float) -> tuple[Matrix, Matrix]:
    """The radius is an angle: ``atan(2 r tan(omega / 2)) / omega``."""
    r = np.hypot(u, v)
    if omega * omega < _TINY:
        return u, v
    slope = 2 * np.tan(omega / 2)
    factor = np.where(r * r < _TINY, slope / omega, np.arctan(r * slope) / (np.maximum(r, _TINY) * omega))
    return u * factor, v * factor


def equidistant(u: Matrix, v: Matrix, *k: float) -> tuple[Matrix, Matrix]:
    """The radius is the angle to the axis, times a polynomial in its square with coefficients k."""
    r = np.hypot(u, v)
    theta = np.arctan(r)
    factor = np.where(r * r < _TINY, 1.0, theta / np.maximum(r, _TINY)) * _polynomial(theta * theta, k)
    return u * factor, v * factor


def thin_prism(u: Matrix, v: Matrix, *c: float) -> tuple[Matrix, Matrix]:
    """A fish-eye whose sensor is tilted (Weng et al., PAMI 1992)."""
    k1, k2, p1, p2, k3, k4, sx1, sy1 = c
    u, v = equidistant(u, v)
    r2 = u * u + v * v
    du, dv = _decentred(u, v, r2, p1, p2)
    factor = _polynomial(r2, (k1, k2, k3, k4))
    return u * factor + du + sx1 * r2, v * factor + dv + sy1 * r2


def rad_tan_thin_prism(u: Matrix, v: Matrix, *c: float) -> tuple[Matrix, Matrix]:
    """The fish-eye of Project Aria's cameras: six radial, two tangential and four thin-prism coefficients."""
    (p0, p1), (s0, s1, s2, s3) = c[6:8], c[8:]
    u, v = equidistant(u, v, *c[:6])
    r2 = u * u + v * v
    du, dv = _decentred(u, v, r2, p1, p0)
    return u + du + r2 * (s0 + r2 * s1), v + dv + r2 * (s2 + r2 * s3)


def division(u: Matrix, v: Matrix, k: float) -> tuple[Matrix, Matrix]:
    """The undistorted point is the distorted one divided by ``1 + k r^2``. NaN beyond the largest radius for k > 0."""
    root = 1 - 4 * k * (u * u + v * v)
    with np.errstate(invalid="ignore"):
        factor = 2 / (1 + np.sqrt(root))
    return u * factor, v * factor


def unified(u: Matrix, v: Matrix, alpha: float, beta: float) -> tuple[Matrix, Matrix]:
    """The enhanced unified camera model (Khomutenko et al., RA-L 2016)."""
    factor = 1 / (alpha * np.sqrt(beta * (u * u + v * v) + 1) + 1 - alpha)
    return u * factor, v * factor


def _decentred(u: Matrix, v: Matrix, r2: Matrix, p1: float, p2: float) -> tuple[Matrix, Matrix]:
    return 2 * p1 * u * v + p2 * (r2 + 2 * u * u), 2 * p2 * u * v + p1 * (r2 + 2 * v * v)


def _polynomial(x: Matrix, k: tuple[float, ...]) -> Matrix:
    total = np.zeros_like(x)
    for coefficient in reversed(k):
        total = (total + coefficient) * x
    return 1 + total


MODELS = {
    "SIMPLE_PINHOLE": Model(1, "", radial), "PINHOLE": Model(2, "", radial),
    "SIMPLE_RADIAL": Model(1, "k", radial), "RADIAL": Model(1, "k1 k2", radial),
    "OPENCV": Model(2, "k1 k2 p1 p2", rational), "OPENCV_FISHEYE": Model(2, "k1 k2 k3 k4", equidistant, fisheye=True),
    "FULL_OPENCV": Model(2, "k1 k2 p1 p2 k3 k4 k5 k6", rational), "FOV": Model(2, "omega", field_of_view),
    "SIMPLE_RADIAL_FISHEYE": Model(1, "k", equidistant, fisheye=True),
    "RADIAL_FISHEYE": Model(1, "k1 k2", equidistant, fisheye=True),
    "THIN_PRISM_FISHEYE": Model(2, "k1 k2 p1 p2 k3 k4 sx1 sy1", thin_prism, fisheye=True),
    "RAD_TAN_THIN_PRISM_FISHEYE": Model(2, "k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3", rad_tan_thin_prism, fisheye=True),
    "SIMPLE_DIVISION": Model(1, "k", division), "DIVISION": Model(2, "k", division),
    "SIMPLE_FISHEYE": Model(1, "", equidistant, fisheye=True), "FISHEYE": Model(2, "", equidistant, fisheye=True),
    "EUCM": Model(2, "alpha beta", unified),
}  # fmt: skip
"""The models by name, in the order of the numbers that COLMAP's binary files give them."""


# Points and local affine frames of photographs as a pinhole of the same K would have them

ITERATIONS = 50  # at most; most points take four
STEP = 1e-6  # of the derivatives, in units of the focal length
TOLERANCE = 1e-10  # of distorted points, likewise: 1e-7 px at a focal length of 1000 px
RAY = np.linspace(0.0, 1.0, 33)  # where, from the centre to a point, a lens must lead outwards
FRAME_STEP = 0.5  # px: a frame's columns are moved by the lens as short steps of that length


def undistorted_points(lens: Lens, photographed: Array) -> Matrix:
    """Pixels (..., 2) of a pinhole of calibration `lens.K` for those of the photograph; NaN where it sees nothing.
    The inverse of `Lens.distort` by Newton's method. NaN too where the model folds back between centre and point: there
    a polynomial has left the range to which it was fitted, as `undistorted` leaves such pixels black."""
    points: Matrix = np.array(photographed, np.float64)
    if not lens.bends:
        return points
    centre, focal = np.array([lens.cx, lens.cy]), np.array([lens.fx, lens.fy])
    target = (points.reshape(-1, 2) - centre) / focal
    with np.errstate(all="ignore"):
        x = _inverted(lens, target)
    return np.asarray(x * focal + centre, np.float64).reshape(points.shape)


def undistorted_frames(undistorted: Callable[[Matrix], Matrix], photographed: Array, frames: Array) -> Matrix:
    """Local affine frames (n, 2, 2), by columns, of a pinhole's image, by the lens's derivatives at points (n, 2)."""
    points: Matrix = np.array(photographed, np.float64)
    there = undistorted(points)
    moved = [undistorted(points + step) - there for step in FRAME_STEP * np.eye(2)]
    return np.asarray(np.stack(moved, -1) / FRAME_STEP @ frames, np.float64)


def _inverted(lens: Lens, target: Matrix) -> Matrix:
    """Normalised points (n, 2) that the lens puts at the target (n, 2)."""

    def distort(x: Matrix) -> Matrix:
        return np.stack(MODELS[lens.model].distort(x[..., 0], x[..., 1], *lens.coefficients), -1)

    x = target.copy()
    if MODELS[lens.model].fisheye:  # whose radius is about the angle to the axis
        angle = np.hypot(target[:, 0], target[:, 1])
        x = np.where((angle > 0)[:, None], target * (np.tan(angle) / angle)[:, None], target)
        x = np.where((angle < np.pi / 2)[:, None], x, target)
    error = distort(x) - target
    for _ in range(ITERATIONS):
        size = np.hypot(error[:, 0], error[:, 1])
        if not (size > TOLERANCE).any():
            break
        J = np.stack([(distort(x + step) - distort(x - step)) / (2 * STEP) for step in STEP * np.eye(2)], -1)
        (a, b), (c, d), (u, v) = (J[:, 0].T, J[:, 1].T, error.T)
        move = np.stack([d * u - b * v, a * v - c * u], -1) / (a * d - b * c)[:, None]
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
