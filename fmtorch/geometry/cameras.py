"""Fundamental matrices from cameras, ``x1^T F x0 = 0``, image 0 first.

Matrices are of any scale and sign, leading dimensions broadcast, and a result is bit-equal in any batch."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.geometry.arithmetic import matmul3, sqrt
from fmtorch.geometry.epipolar import Matrix, unit_frobenius, unit_largest


def cross_matrix(t: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The skew-symmetric matrix [t]_x with ``[t]_x v = t x v``."""
    x, y, z = t.unbind(-1)
    zero = torch.zeros_like(x)
    return _matrix([zero, -z, y, z, zero, -x, -y, x, zero])


def fundamental_from_projections(
    P0: Float[Tensor, "*#batch 3 4"], P1: Float[Tensor, "*#batch 3 4"]
) -> Float[Tensor, "*#batch 3 3"]:
    """F of unit Frobenius norm between two cameras: ``F = [P1 C]_x P1 P0^+`` with ``P0 C = 0``, without a null space.

    Each element is a 4 x 4 determinant of two rows of P0 and two of P1 (Hartley & Zisserman, Multiple View Geometry,
    2nd ed., eq. 17.3), so it holds for finite and infinite cameras and is smooth in both. Cameras with one centre
    have no fundamental matrix: the zero matrix is returned.

    Args:
        P0: projection (..., 3, 4) of image 0, world to pixels, of any scale.
        P1: that of image 1; leading dimensions broadcast.

    Returns:
        (..., 3, 3).
    """
    lines0, lines1 = _pluecker_of_row_pairs(unit_largest(P0)), _pluecker_of_row_pairs(unit_largest(P1))
    # The sign is that of [t]_x for P0 = [I | 0], P1 = [I | t].
    return unit_frobenius(_matrix([-_determinant(lines0[i], lines1[j]) for j in range(3) for i in range(3)]))


def fundamental_from_calibration(K0: Matrix, K1: Matrix, R: Matrix, t: Float[Tensor, "*#batch 3"]) -> Matrix:
    """F = K1^-T [t]_x R K0^-1 of unit Frobenius norm, for ``X1 = R X0 + t`` (Hartley & Zisserman, eq. 9.12).

    Args:
        K0: calibration matrix (..., 3, 3) of image 0.
        K1: that of image 1.
        R: rotation (..., 3, 3) from camera 0 to camera 1.
        t: translation (..., 3), of any length but zero.

    Returns:
        (..., 3, 3).

    Example:
        >>> import torch
        >>> from fmtorch.geometry import algebraic, fundamental_from_calibration
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> F = fundamental_from_calibration(K, K, torch.eye(3), torch.tensor([1.0, 0, 0]))  # a step to the right
        >>> x0, x1 = torch.tensor([[100.0, 50]]), torch.tensor([[60.0, 50]])  # the same row
        >>> bool(algebraic(F, x0, x1).abs() < 1e-6)
        True
    """
    E = matmul3(cross_matrix(t), R)
    inverse0 = _cofactors(unit_largest(K0)).mT  # K^-1 up to the scale det K
    inverse1_t = _cofactors(unit_largest(K1))
    return unit_frobenius(matmul3(matmul3(inverse1_t, unit_largest(E)), inverse0))


def _matrix(elements: list[Tensor]) -> Tensor:
    stacked = torch.stack(elements, -1)
    return stacked.reshape(*stacked.shape[:-1], 3, 3)


def _cofactors(matrix: Tensor) -> Tensor:
    """det(M) M^-T: each element is the minor of the rows and columns that follow it cyclically."""
    roll = matrix.roll
    return roll((-1, -1), (-2, -1)) * roll((-2, -2), (-2, -1)) - roll((-1, -2), (-2, -1)) * roll((-2, -1), (-2, -1))


def _pluecker_of_row_pairs(P: Tensor) -> list[list[Tensor]]:
    """For i = 0, 1, 2 the minors of the two rows of P other than i, in cyclic order: columns 01, 02, 03, 12, 13, 23."""
    columns = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    rows = [(1, 2), (2, 0), (0, 1)]
    return [[P[..., r, a] * P[..., s, b] - P[..., r, b] * P[..., s, a] for a, b in columns] for r, s in rows]


def _determinant(line0: list[Tensor], line1: list[Tensor]) -> Tensor:
    """The 4 x 4 determinant of two rows above two others, by Laplace expansion in 2 x 2 minors."""
    (a01, a02, a03, a12, a13, a23), (b01, b02, b03, b12, b13, b23) = line0, line1
    return a01 * b23 - a02 * b13 + a03 * b12 + a12 * b03 - a13 * b02 + a23 * b01


# Images of known calibration as those of a camera with square pixels and a central principal point

MIN_FOCAL, MAX_FOCAL = 0.1, 10.0  # in units of the longer side; K of other focal lengths is of another unit or image
MAX_KNOWN_FOCAL = 1000.0  # in units of the longer side, of a camera of any kind
MAX_OFF = 1000.0  # in units of the longer side; the principal point of a crop may lie outside it, if not so far
MIN_SIDE_PX, MAX_SIDE_PX = 16.0, 1e6  # longer sides, or focal lengths, of coordinates that are pixels
NOMINAL_FOCAL_PX = 1000.0  # of the image that points of another unit, such as normalised ones, are mapped to
USUAL_FOCAL = 1.2  # in units of the longer side, where neither size nor principal point tells that


class SquarePixels(NamedTuple):
    """The images that B images are mapped to.
    map: from coordinates of K to those of K', attached to K; that of a faulty K is the identity. focal: of K', px,
    constant. size: (h, w), px. unit: the focal length of K in that of K', attached."""

    map: Float[Tensor, "b 3 3"]
    focal: Float[Tensor, " b"]
    size: Float[Tensor, "b 2"]
    unit: Float[Tensor, " b"]


def square_pixels(
    K: Float[Tensor, "b 3 3"], size: Real[Tensor, "b 2"] | None, valid: Bool[Tensor, " b"]
) -> SquarePixels:
    """Square pixels of the focal length f = sqrt(fx fy) of K; skew is allowed. Float64.

    Args:
        K: calibration matrices (B, 3, 3), rows (fx, s, cx), (0, fy, cy), (0, 0, 1).
        size: (B, 2), (h, w) in the unit of K. None: twice the principal point, or where that is none of an image, as of
            normalised points, a square around it of the usual focal length.
        valid: (B,), where `calibration_problems` has nothing to say.

    Returns:
        `SquarePixels`. Where the longer side (or, if that is not known, the focal length) is not within MIN_SIDE_PX and
        MAX_SIDE_PX, the unit is not a pixel, and points are mapped to an image of a focal length of NOMINAL_FOCAL_PX.
    """
    K = torch.where(valid[:, None, None], K.to(torch.float64), torch.eye(3, dtype=torch.float64, device=K.device))
    K = K / K[:, 2:, 2:]
    fx, skew, cx, fy, cy = K[:, 0, 0], K[:, 0, 1], K[:, 0, 2], K[:, 1, 1], K[:, 1, 2]
    focal, image, in_pixels = _image(K.detach(), size)
    scale = torch.where(~in_pixels, NOMINAL_FOCAL_PX / focal, 1.0)
    f, image = focal * scale, image * scale[:, None]
    x, y = (image[:, 1] - 1) / 2, (image[:, 0] - 1) / 2
    zero, ones = torch.zeros_like(fx), torch.ones_like(fx)
    across = -f * skew / (fx * fy)
    rows = [f / fx, across, x - f / fx * cx - across * cy, zero, f / fy, y - f / fy * cy, zero, zero, ones]
    A = torch.where(valid[:, None], torch.stack(rows, -1), torch.eye(3, dtype=K.dtype, device=K.device).flatten())
    return SquarePixels(A.reshape(-1, 3, 3), f, image, sqrt(fx * fy) / f)


def _image(K: Tensor, size: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Focal lengths and sizes in the unit of K, and whether that is a pixel."""
    focal = sqrt(K[:, 0, 0] * K[:, 1, 1])
    if size is not None:
        image = size.to(torch.float64)
        return focal, image, (image.amax(1) >= MIN_SIDE_PX) & (image.amax(1) <= MAX_SIDE_PX)
    centre = K[:, [1, 0], 2]
    longest = centre.amax(1) * 2 + 1
    central = (centre > 0).all(1) & (longest * MIN_FOCAL < focal) & (focal < longest * MAX_FOCAL)
    square = (focal / USUAL_FOCAL)[:, None].expand(-1, 2)
    in_pixels = (focal >= MIN_SIDE_PX) & (focal <= MAX_SIDE_PX)
    return focal, torch.where(central[:, None], 2 * centre + 1, square), in_pixels


def calibration_problems(
    K: Float[Tensor, "b 3 3"], size: Real[Tensor, "b 2"] | None, name: str = "K"
) -> tuple[str, ...]:
    """Why each K (B, 3, 3) is no calibration matrix of an image of its size (B, 2); empty where it may be one.

    Args:
        K: calibration matrices.
        size: (h, w) in the unit of K, None where unknown.
        name: of the argument that K is, with which a reason begins.
    """
    sizes = [None] * len(K) if size is None else size.detach().cpu().double().numpy()
    return tuple(_problem(k, s, name) for k, s in zip(K.detach().cpu().double().numpy(), sizes, strict=True))


def _problem(K: NDArray[np.float64], size: NDArray[np.float64] | None, name: str) -> str:
    if not np.isfinite(K).all():
        return f"{name} is not finite"
    if 0 in (K[0, 0], K[1, 1], K[2, 2]):
        return f"{name} is singular; its rows must be (fx, s, cx), (0, fy, cy), (0, 0, 1)"
    K = K / K[2, 2]
    if K[1, 0] != 0 or K[2, 0] != 0 or K[2, 1] != 0:
        return f"{name} is {K.tolist()}; its rows must be (fx, s, cx), (0, fy, cy), (0, 0, 1)"
    if K[0, 0] < 0 or K[1, 1] < 0:
        return f"{name} has focal lengths {K[0, 0]:g}, {K[1, 1]:g}; they must be positive"
    if size is None or not (size > 0).all():
        return ""
    h, w = size.tolist()
    if absurd := [f for f in (K[0, 0], K[1, 1]) if not MIN_FOCAL * max(h, w) <= f <= MAX_KNOWN_FOCAL * max(h, w)]:
        return f"{name} has a focal length of {absurd[0]:g} for an image of {w:g} x {h:g} pixels; it must be in pixels"
    if max(abs(K[0, 2]), abs(K[1, 2])) > MAX_OFF * max(h, w):
        return f"{name} has the principal point ({K[0, 2]:g}, {K[1, 2]:g}), far outside an image of {w:g} x {h:g} px"
    return ""


def mapped(x: Float[Tensor, "*batch n 2"], A: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch n 2"]:
    """Points (..., N, 2) by affine maps (..., 3, 3), in the points' type."""
    rows = A[..., None, :2, :]
    return (rows[..., 0] * x[..., :1] + rows[..., 1] * x[..., 1:] + rows[..., 2]).to(x.dtype)


# The frame in which solvers and fits compute: each image's points centred, both in one unit of a power of two
# pixels


class PixelFrame(NamedTuple):
    """Normalised coordinates of P pairs: ``pixel = centre + pixels_per_unit * coordinate``; constants, float64.
    centre: middle of the box around the points of each image, x0, y0, x1, y1. pixels_per_unit: a power of two, so that
    the larger box reaches from about -1 to 1; 1 where all points are one."""

    centre: Float[Tensor, "p 4"]
    pixels_per_unit: Float[Tensor, " p"]

    @classmethod
    def around(cls, pixels: Float[Tensor, "p n 4"], mask: Bool[Tensor, "p n"]) -> "PixelFrame":
        """The frame of the points in the mask, float64."""
        x, inside = pixels.detach(), mask[..., None]
        if x.shape[1]:
            low = torch.where(inside, x, torch.inf).amin(1)
            high = torch.where(inside, x, -torch.inf).amax(1)
        else:
            low = high = x.new_zeros(len(x), 4)
        nonempty = mask.any(1)
        centre = torch.where(nonempty[:, None], (low + high) / 2, 0)
        half = torch.where(nonempty, ((high - low) / 2).amax(-1), 0)
        size = half.clamp(1e-300, 1e300)
        mantissa = torch.frexp(size).mantissa
        unit = torch.where(mantissa == 0.5, size, size / mantissa)  # the power of two from there up: exact
        return cls(centre, torch.where(half > 0, unit, 1))

    def normalized(self, pixels: Float[Tensor, "p n 4"]) -> Float[Tensor, "p n 4"]:
        """Points in the frame; attached to the graph of the pixels."""
        return (pixels - self.centre[:, None]) / self.pixels_per_unit[:, None, None]

    def to_pixels(self, F: Float[Tensor, "p k 3 3"], homographies: bool = False) -> Float[Tensor, "p k 3 3"]:
        """Fundamental matrices, or homographies, of points in the frame as those of pixels, of any scale."""
        (_, back0), (there1, back1) = self._maps(0), self._maps(2)
        return matmul3(matmul3(there1 if homographies else back1.mT, F), back0)

    def from_pixels(self, F: Float[Tensor, "p k 3 3"], homographies: bool = False) -> Float[Tensor, "p k 3 3"]:
        """Fundamental matrices, or homographies, of pixels as those of points in the frame, of any scale."""
        (there0, _), (there1, back1) = self._maps(0), self._maps(2)
        return matmul3(matmul3(back1 if homographies else there1.mT, F), there0)

    def _maps(self, first: int) -> tuple[Float[Tensor, "p 1 3 3"], Float[Tensor, "p 1 3 3"]]:
        """Map the frame's points of one image to pixels, and these to the frame's."""
        unit, shift = self.pixels_per_unit, self.centre[:, first : first + 2]
        maps = []
        for scale, moved in ((unit, shift), (1 / unit, -shift / unit[:, None])):
            A = torch.diag_embed(torch.stack([scale, scale, torch.ones_like(scale)], -1))
            A[:, :2, 2] = moved
            maps.append(A[:, None])
        return maps[0], maps[1]
