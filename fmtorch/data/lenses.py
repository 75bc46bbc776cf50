"""Lens models: where a lens puts what an ideal pinhole would have put elsewhere. All of COLMAP's, by its names.

A model maps normalised image points (u, v) = (X / Z, Y / Z) to distorted ones; pixels follow by fx, fy, cx, cy. The
formulas are those of COLMAP's documentation of camera models; OPENCV and FULL_OPENCV are OpenCV's, OPENCV_FISHEYE is
that of Kannala and Brandt (PAMI 2006), FOV of Devernay and Faugeras (2001), DIVISION of Fitzgibbon (CVPR 2001).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Distortion = Callable[..., tuple[Array, Array]]

_TINY = 1e-12  # squared radius or parameter below which a quotient is replaced by its limit


@dataclasses.dataclass(frozen=True)
class Lens:
    """A lens: focal lengths and principal point in pixels, with (0, 0) at the centre of the first pixel, and a model.

    coefficients: of the model, as `MODELS` names them, without focal lengths and principal point.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "PINHOLE"
    coefficients: tuple[float, ...] = ()

    @property
    def K(self) -> Array:
        """The calibration (3, 3) of the undistorted image."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def bends(self) -> bool:
        """Whether the image differs from a pinhole's."""
        return MODELS[self.model].fisheye or any(self.coefficients)

    def distort(self, points: Array) -> Array:
        """Where points (..., 2) of the undistorted image are in the photograph, both in pixels."""
        u, v = (points[..., 0] - self.cx) / self.fx, (points[..., 1] - self.cy) / self.fy
        u, v = MODELS[self.model].distort(u, v, *self.coefficients)
        return np.stack([self.fx * u + self.cx, self.fy * v + self.cy], -1)


@dataclasses.dataclass(frozen=True)
class Model:
    """A lens model.

    focals: whether it has one focal length or two. coefficients: names of its parameters after the principal point.
    fisheye: whether it bends even where all of them are zero.
    """

    focals: int
    coefficients: str
    distort: Distortion
    fisheye: bool = False

    @property
    def parameters(self) -> list[str]:
        """The names of all parameters, in COLMAP's order."""
        return [*(["f"] if self.focals == 1 else ["fx", "fy"]), "cx", "cy", *self.coefficients.split()]

    def lens(self, name: str, values: Array) -> Lens:
        """The lens of a model's parameters, whose principal point has the origin of the lens."""
        fx, fy = (values[0], values[0]) if self.focals == 1 else (values[0], values[1])
        cx, cy = values[self.focals : self.focals + 2]
        return Lens(float(fx), float(fy), float(cx), float(cy), name, tuple(map(float, values[self.focals + 2 :])))


def pinhole(u: Array, v: Array) -> tuple[Array, Array]:
    """No distortion."""
    return u, v


def radial(u: Array, v: Array, k1: float = 0.0, k2: float = 0.0) -> tuple[Array, Array]:
    """A polynomial in the squared radius."""
    r2 = u * u + v * v
    factor = 1 + r2 * (k1 + r2 * k2)
    return u * factor, v * factor


def rational(
    u: Array, v: Array,
    k1: float, k2: float, p1: float, p2: float, k3: float = 0.0, k4: float = 0.0, k5: float = 0.0, k6: float = 0.0,
) -> tuple[Array, Array]:  # fmt: skip
    """A quotient of polynomials, and decentring (Brown): OpenCV's model."""
    r2 = u * u + v * v
    factor = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    du, dv = _decentred(u, v, r2, p1, p2)
    return u * factor + du, v * factor + dv


def field_of_view(u: Array, v: Array, omega: float) -> tuple[Array, Array]:
    """The radius is an angle: ``atan(2 r tan(omega / 2)) / omega``."""
    r = np.hypot(u, v)
    if omega * omega < _TINY:
        return u, v
    slope = 2 * np.tan(omega / 2)
    factor = np.where(r * r < _TINY, slope / omega, np.arctan(r * slope) / (np.maximum(r, _TINY) * omega))
    return u * factor, v * factor


def equidistant(u: Array, v: Array, *k: float) -> tuple[Array, Array]:
    """The radius is the angle to the axis, times a polynomial in its square with coefficients k."""
    r = np.hypot(u, v)
    theta = np.arctan(r)
    factor = np.where(r * r < _TINY, 1.0, theta / np.maximum(r, _TINY)) * _polynomial(theta * theta, k)
    return u * factor, v * factor


def thin_prism(
    u: Array, v: Array,
    k1: float, k2: float, p1: float, p2: float, k3: float, k4: float, sx1: float, sy1: float,
) -> tuple[Array, Array]:  # fmt: skip
    """A fish-eye whose sensor is tilted (Weng et al., PAMI 1992)."""
    u, v = equidistant(u, v)
    r2 = u * u + v * v
    du, dv = _decentred(u, v, r2, p1, p2)
    factor = _polynomial(r2, (k1, k2, k3, k4))
    return u * factor + du + sx1 * r2, v * factor + dv + sy1 * r2


def rad_tan_thin_prism(u: Array, v: Array, *c: float) -> tuple[Array, Array]:
    """The fish-eye of Project Aria's cameras: six radial, two tangential and four thin-prism coefficients."""
    (p0, p1), (s0, s1, s2, s3) = c[6:8], c[8:]
    u, v = equidistant(u, v, *c[:6])
    r2 = u * u + v * v
    du, dv = _decentred(u, v, r2, p1, p0)
    return u + du + r2 * (s0 + r2 * s1), v + dv + r2 * (s2 + r2 * s3)


def division(u: Array, v: Array, k: float) -> tuple[Array, Array]:
    """The undistorted point is the distorted one divided by ``1 + k r^2``. NaN beyond the largest radius for k > 0."""
    root = 1 - 4 * k * (u * u + v * v)
    with np.errstate(invalid="ignore"):
        factor = 2 / (1 + np.sqrt(root))
    return u * factor, v * factor


def unified(u: Array, v: Array, alpha: float, beta: float) -> tuple[Array, Array]:
    """The enhanced unified camera model (Khomutenko et al., RA-L 2016)."""
    factor = 1 / (alpha * np.sqrt(beta * (u * u + v * v) + 1) + 1 - alpha)
    return u * factor, v * factor


def _decentred(u: Array, v: Array, r2: Array, p1: float, p2: float) -> tuple[Array, Array]:
    return 2 * p1 * u * v + p2 * (r2 + 2 * u * u), 2 * p2 * u * v + p1 * (r2 + 2 * v * v)


def _polynomial(x: Array, k: tuple[float, ...]) -> Array:
    """1 + k[0] x + k[1] x^2 + ..."""
    total = np.zeros_like(x)
    for coefficient in reversed(k):
        total = (total + coefficient) * x
    return 1 + total


MODELS = {
    "SIMPLE_PINHOLE": Model(1, "", pinhole),
    "PINHOLE": Model(2, "", pinhole),
    "SIMPLE_RADIAL": Model(1, "k", radial),
    "RADIAL": Model(1, "k1 k2", radial),
    "OPENCV": Model(2, "k1 k2 p1 p2", rational),
    "OPENCV_FISHEYE": Model(2, "k1 k2 k3 k4", equidistant, fisheye=True),
    "FULL_OPENCV": Model(2, "k1 k2 p1 p2 k3 k4 k5 k6", rational),
    "FOV": Model(2, "omega", field_of_view),
    "SIMPLE_RADIAL_FISHEYE": Model(1, "k", equidistant, fisheye=True),
    "RADIAL_FISHEYE": Model(1, "k1 k2", equidistant, fisheye=True),
    "THIN_PRISM_FISHEYE": Model(2, "k1 k2 p1 p2 k3 k4 sx1 sy1", thin_prism, fisheye=True),
    "RAD_TAN_THIN_PRISM_FISHEYE": Model(
        2, "k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3", rad_tan_thin_prism, fisheye=True
    ),
    "SIMPLE_DIVISION": Model(1, "k", division),
    "DIVISION": Model(2, "k", division),
    "SIMPLE_FISHEYE": Model(1, "", equidistant, fisheye=True),
    "FISHEYE": Model(2, "", equidistant, fisheye=True),
    "EUCM": Model(2, "alpha beta", unified),
}  # fmt: skip
"""The models by name, in the order of the numbers that COLMAP's binary files give them."""
