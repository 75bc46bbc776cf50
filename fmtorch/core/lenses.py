"""Calibrated lenses: where they put what a pinhole would have put elsewhere. All of COLMAP's models, by its names."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Behind = bool | NDArray[np.bool_]
Distortion = Callable[..., tuple[Matrix, Matrix]]
_TINY = 1e-12  # squared radius or parameter below which a quotient is replaced by its limit


@dataclasses.dataclass(frozen=True)
class Lens:
    """A calibrated lens: focal lengths and principal point in pixels, with (0, 0) at the centre of the first pixel.
    model: its name in COLMAP, of `fmtorch.data.MODELS`. coefficients: as `MODELS` names them, without focal lengths and
    principal point. Raises ValueError for an unknown model and for other coefficients than its own, TypeError for what
    are no numbers."""

    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "PINHOLE"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"lens model {self.model!r}; there are: {', '.join(MODELS)}")
        names = MODELS[self.model].coefficients.split()
        given = getattr(self.coefficients, "tolist", lambda: self.coefficients)()  # of an array, a tensor or a number
        object.__setattr__(self, "coefficients", tuple(given) if isinstance(given, list | tuple) else (given,))
        for value in (self.fx, self.fy, self.cx, self.cy, *self.coefficients):
            if not hasattr(value, "__float__"):
                raise TypeError(f"a lens has {value!r} among its parameters; they must be numbers")
        if len(self.coefficients) != len(names):
            has = f"has coefficients {', '.join(names)}" if names else "has no coefficients"
            raise ValueError(f"a lens of the model {self.model} {has}; {len(self.coefficients)} are given")

    @property
    def K(self) -> Matrix:
        """The calibration (3, 3) of the undistorted image."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def bends(self) -> bool:
        """Whether the image differs from a pinhole's."""
        return MODELS[self.model].fisheye or any(self.coefficients)

    def distort(self, points: Matrix, behind: Behind = False) -> Matrix:
        """Where points (..., 2) of the undistorted image are in the photograph, both in pixels.
        behind: which of them stand for what is behind the camera, as those of `lines_of_sight` do."""
        u, v = (points[..., 0] - self.cx) / self.fx, (points[..., 1] - self.cy) / self.fy
        w = np.where(behind, -1.0, 1.0)
        u, v = MODELS[self.model].photographed(w * u, w * v, w, self.coefficients)
        return np.stack([self.fx * u + self.cx, self.fy * v + self.cy], -1)

    def derivatives(self, points: Matrix, behind: Behind = False) -> Matrix:
        """The derivatives (..., 2, 2) of `distort` there."""
        slant = 1 + (((points - [self.cx, self.cy]) / [self.fx, self.fy]) ** 2).sum(-1, keepdims=True)
        return _derivatives(lambda x: self.distort(x, behind), points, STEP * self.fx * slant)

    def scaled(self, sx: float, sy: float) -> "Lens":
        """The lens of the photograph whose width and height are resampled to so many times theirs."""
        centre = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        return Lens(self.fx * sx, self.fy * sy, *centre, self.model, self.coefficients)


@dataclasses.dataclass(frozen=True)
class Model:
    """A lens model.
    focals: whether it has one focal length or two. coefficients: names of its parameters after the principal point.
    distort: of points (u, v) of a pinhole's image, or where it is a fish-eye, which bends even where all coefficients
    are zero, of angles to the axis; or of rays (u, v, w), where `rays` is its inverse."""

    focals: int
    coefficients: str
    distort: Distortion
    fisheye: bool = False
    rays: Callable[..., tuple[Matrix, Matrix, Matrix]] | None = None

    @property
    def parameters(self) -> list[str]:
        """The names of all parameters, in COLMAP's order."""
        return [*(["f"] if self.focals == 1 else ["fx", "fy"]), "cx", "cy", *self.coefficients.split()]

    def lens(self, name: str, values: Matrix) -> Lens:
        """The lens of a model's parameters, whose principal point has the origin of the lens."""
        fx, fy = (values[0], values[0]) if self.focals == 1 else (values[0], values[1])
        cx, cy = values[self.focals : self.focals + 2]
        return Lens(float(fx), float(fy), float(cx), float(cy), name, tuple(map(float, values[self.focals + 2 :])))

    def photographed(self, u: Matrix, v: Matrix, w: Matrix, coefficients: Sequence[float]) -> tuple[Matrix, Matrix]:
        """Where a lens of focal length 1 puts rays (u, v, w) of any length."""
        if self.rays is not None:
            return self.distort(u, v, w, *coefficients)
        if self.fisheye:
            r = np.hypot(u, v)
            angle = np.where(r * r < _TINY, 1.0, np.arctan2(r, w) / np.maximum(r, _TINY))
            u, v = u * angle, v * angle
        return self.distort(u, v, *coefficients)

    def rays_of(self, x: Matrix, coefficients: Sequence[float]) -> tuple[Matrix, Matrix, Matrix]:
        """The rays (u, v, w) that it puts at points (n, 2); NaN where there is none."""
        if self.rays is not None:
            return self.rays(*x.T, *coefficients)
        u, v = _inverted(lambda x: np.stack(self.distort(*np.moveaxis(x, -1, 0), *coefficients), -1), x).T
        if not self.fisheye:
            return u, v, np.ones_like(u)
        angle = np.hypot(u, v)
        sine = np.where(angle < np.pi, np.sinc(angle / np.pi), np.nan)
        return u * sine, v * sine, np.cos(angle)


def radial(u: Matrix, v: Matrix, *k: float) -> tuple[Matrix, Matrix]:
    """A polynomial in the squared radius with coefficients k; none of a pinhole, or of an equidistant fish-eye."""
    factor = _polynomial(u * u + v * v, k)
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


def thin_prism(u: Matrix, v: Matrix, *c: float) -> tuple[Matrix, Matrix]:
    """A fish-eye whose sensor is tilted (Weng et al., PAMI 1992)."""
    k1, k2, p1, p2, k3, k4, sx1, sy1 = c
    r2 = u * u + v * v
    du, dv = _decentred(u, v, r2, p1, p2)
    factor = _polynomial(r2, (k1, k2, k3, k4))
    return u * factor + du + sx1 * r2, v * factor + dv + sy1 * r2


def rad_tan_thin_prism(u: Matrix, v: Matrix, *c: float) -> tuple[Matrix, Matrix]:
    """The fish-eye of Project Aria's cameras: six radial, two tangential and four thin-prism coefficients."""
    (p0, p1), (s0, s1, s2, s3) = c[6:8], c[8:]
    u, v = radial(u, v, *c[:6])
    r2 = u * u + v * v
    du, dv = _decentred(u, v, r2, p1, p0)
    return u + du + r2 * (s0 + r2 * s1), v + dv + r2 * (s2 + r2 * s3)


def division(u: Matrix, v: Matrix, w: Matrix, k: float) -> tuple[Matrix, Matrix]:
    """A ray's point divided by ``1 + k r^2`` is the undistorted one. NaN beyond the largest radius for k > 0."""
    with np.errstate(invalid="ignore"):
        factor = 2 / (w + np.sqrt(w * w - 4 * k * (u * u + v * v)))
    return u * factor, v * factor


def division_rays(u: Matrix, v: Matrix, k: float) -> tuple[Matrix, Matrix, Matrix]:
    """The inverse of `division`, up to the largest radius of a pinhole's image for k > 0."""
    bend = k * (u * u + v * v)
    return u, v, np.where(bend < 1, 1 + bend, np.nan)


def unified(u: Matrix, v: Matrix, w: Matrix, alpha: float, beta: float) -> tuple[Matrix, Matrix]:
    """The enhanced unified camera model (Khomutenko et al., RA-L 2016, eq. 5)."""
    factor = 1 / (alpha * np.sqrt(beta * (u * u + v * v) + w * w) + (1 - alpha) * w)
    return u * factor, v * factor


def unified_rays(u: Matrix, v: Matrix, alpha: float, beta: float) -> tuple[Matrix, Matrix, Matrix]:
    """The inverse of `unified` (eq. 10); NaN beyond its largest radius."""
    r2 = beta * (u * u + v * v)
    root = np.sqrt(1 - (2 * alpha - 1) * r2)
    return u, v, (1 - alpha * alpha * r2) / (alpha * root + 1 - alpha)


def _decentred(u: Matrix, v: Matrix, r2: Matrix, p1: float, p2: float) -> tuple[Matrix, Matrix]:
    return 2 * p1 * u * v + p2 * (r2 + 2 * u * u), 2 * p2 * u * v + p1 * (r2 + 2 * v * v)


def _polynomial(x: Matrix, k: tuple[float, ...]) -> Matrix:
    total = np.zeros_like(x)
    for coefficient in reversed(k):
        total = (total + coefficient) * x
    return 1 + total


MODELS = {  # the models by name, in the order of the numbers that COLMAP's binary files give them
    "SIMPLE_PINHOLE": Model(1, "", radial), "PINHOLE": Model(2, "", radial),
    "SIMPLE_RADIAL": Model(1, "k", radial), "RADIAL": Model(1, "k1 k2", radial),
    "OPENCV": Model(2, "k1 k2 p1 p2", rational), "OPENCV_FISHEYE": Model(2, "k1 k2 k3 k4", radial, fisheye=True),
    "FULL_OPENCV": Model(2, "k1 k2 p1 p2 k3 k4 k5 k6", rational), "FOV": Model(2, "omega", field_of_view),
    "SIMPLE_RADIAL_FISHEYE": Model(1, "k", radial, fisheye=True),
    "RADIAL_FISHEYE": Model(1, "k1 k2", radial, fisheye=True),
    "THIN_PRISM_FISHEYE": Model(2, "k1 k2 p1 p2 k3 k4 sx1 sy1", thin_prism, fisheye=True),
    "RAD_TAN_THIN_PRISM_FISHEYE": Model(2, "k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3", rad_tan_thin_prism, fisheye=True),
    "SIMPLE_DIVISION": Model(1, "k", division, rays=division_rays),
    "DIVISION": Model(2, "k", division, rays=division_rays),
    "SIMPLE_FISHEYE": Model(1, "", radial, fisheye=True), "FISHEYE": Model(2, "", radial, fisheye=True),
    "EUCM": Model(2, "alpha beta", unified, rays=unified_rays),
}  # fmt: skip


# Their inverse

ITERATIONS = 50  # at most; most points take four
STEP = 1e-6  # of the derivatives, in units of the focal length
TOLERANCE = 1e-10  # of distorted points, likewise: 1e-7 px at a focal length of 1000 px
GRAZING = 1e-3  # cotangent of the angle to the axis below which no pinhole's image has the point, in front or behind
JUDGED, MIN_SPREAD = 500, 0.05  # points that tell of a lens; median distance from its centre without it, to with it
RAY = np.linspace(0.0, 1.0, 33)  # where, from the centre to a point, a lens must lead outwards


def division_lens(value: float, size: Sequence[float]) -> Lens:
    """The lens of the division model whose lambda in half diagonals of an image (h, w) is this, about its centre."""
    (h, w), half = size, math.hypot(*size) / 2
    return Lens(half, half, (w - 1) / 2, (h - 1) / 2, "SIMPLE_DIVISION", (value,))


def undistorted_points(lens: Lens, photographed: NDArray[Any]) -> Matrix:
    """Pixels (..., 2) of a pinhole of calibration `lens.K` for those of the photograph; NaN where it sees nothing.
    NaN too where the model folds back between centre and point: there a polynomial has left the range to which it was
    fitted, as `undistorted` leaves such pixels black."""
    points, behind = lines_of_sight(lens, photographed)
    return np.where(behind[..., None], np.nan, points)


def folded(lens: Lens, pixels: Matrix) -> str:
    """What is wrong with a lens that leaves most points (n, 2) no place, or one at its centre; else nothing."""
    pixels, centre = pixels[:: max(1, len(pixels) // JUDGED)], lens.K[:2, 2]
    there, here = (np.linalg.norm(x - centre, axis=1) for x in (undistorted_points(lens, pixels), pixels))
    if not len(pixels) or np.median(np.where(np.isnan(there), 0, there) / np.maximum(here, 1)) >= MIN_SPREAD:
        return ""
    values = " ".join(f"{value:g}" for value in lens.coefficients)
    names = MODELS[lens.model].coefficients
    return f"its lens folds the image or shrinks it to a point ({names} = {values}); calibrate it again"


def lines_of_sight(lens: Lens, photographed: NDArray[Any]) -> tuple[Matrix, NDArray[np.bool_]]:
    """The same, with what is beyond 90 degrees of the axis, where the line of sight, extended backwards, meets the
    pinhole's image; and which points (...,) these are. What holds of lines holds of them, as ``x1^T F x0 = 0``."""
    points: Matrix = np.array(photographed, np.float64)
    if not lens.bends:
        return points, np.zeros(points.shape[:-1], np.bool_)
    centre, focal = np.array([lens.cx, lens.cy]), np.array([lens.fx, lens.fy])
    with np.errstate(all="ignore"):
        target = (points.reshape(-1, 2) - centre) / focal
        u, v, w = MODELS[lens.model].rays_of(target, lens.coefficients)
        w = np.where(np.abs(w) > GRAZING * np.hypot(u, v), w, np.nan)
        x = np.stack([u / w, v / w], -1) * focal + centre
    return np.asarray(x.reshape(points.shape), np.float64), np.asarray(w < 0).reshape(points.shape[:-1])


def undistortion(lens: Lens, pinhole: Matrix, behind: Behind = False) -> Matrix:
    """The derivatives (..., 2, 2) of undistorted points, which these are, by those of the photograph."""
    return _inverse(lens.derivatives(pinhole, behind))


def _derivatives(function: Callable[[Matrix], Matrix], x: Matrix, step: Any) -> Matrix:
    """Those (..., 2, 2) of a function of points (..., 2), by central differences."""
    return np.stack([(function(x + step * e) - function(x - step * e)) / (2 * step) for e in np.eye(2)], -1)


def _inverse(J: Matrix) -> Matrix:
    a, b, c, d = J[..., 0, 0], J[..., 0, 1], J[..., 1, 0], J[..., 1, 1]
    rows = np.stack([d, -b, -c, a], -1) / (a * d - b * c)[..., None]
    return np.asarray(rows.reshape(J.shape), np.float64)


def _inverted(distort: Callable[[Matrix], Matrix], target: Matrix) -> Matrix:
    """Points (n, 2) that a function puts at the target (n, 2), in units of the focal length, by Newton's method.
    Each is a function of its own target alone."""
    x, error = target.copy(), distort(target) - target
    for _ in range(ITERATIONS):
        size = np.hypot(error[:, 0], error[:, 1])
        if not (size > TOLERANCE).any():
            break
        move = (_inverse(_derivatives(distort, x, STEP)) @ error[..., None])[..., 0]
        for share in (1.0, 0.25, 0.0625):  # shorter where the error would grow
            trial = x - share * move
            left = distort(trial) - target
            better = ((size > TOLERANCE) & (np.hypot(left[:, 0], left[:, 1]) < size))[:, None]
            x, error = np.where(better, trial, x), np.where(better, left, error)
            move = np.where(better, 0.0, move)
    along = distort(RAY[:, None, None] * x)  # from the centre outwards
    outwards = (np.diff(along, axis=0) * x).sum(-1) > 0
    valid = (np.hypot(error[:, 0], error[:, 1]) <= TOLERANCE) & (outwards.all(0) | ~x.any(1))
    return np.where(valid[:, None], x, np.nan)
