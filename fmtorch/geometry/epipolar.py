"""Epipolar lines, and the distances between points and them.

Image 0 comes first: ``x1^T F x0 = 0``. Points are (..., N, 2) in pixels, matrices (..., 3, 3) of any scale and sign;
leading dimensions broadcast. Only additions, multiplications, divisions and square roots of single elements are used,
all correctly rounded, so a result is bit-equal whatever stands beside it in the batch. Where an image point falls on
the epipole its line is undefined: its normal is then zero, and distances and gradients to it are 0, never NaN."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.jit.kernel import Array, Inner, inner
from fmtorch.jit.lanes import lanes, where

Matrix = Float[Tensor, "*#batch 3 3"]
Points = Float[Tensor, "*#batch n 2"]
PerMatch = Float[Tensor, "*#batch n"]


def stretch_across(F: Any, points: Any, J: Any) -> Any:
    """The square of how much longer Sampson's distance is than the tangent Sampson error (Terekhov & Larsson, ICCV
    2023), which is of photographs: ``(|J0^T l0|^2 + |J1^T l1|^2) / (|l0|^2 + |l1|^2)``, l0 and l1 the epipolar lines'
    normals; one where there are none. F: (9, ...); points: (4, ..., n); J: (..., n, 2, 2, 2), derivatives of points of
    both images by the photographs'. Arrays or tensors."""
    x0, y0, x1, y1 = points
    line0 = F[0] * x1 + F[3] * y1 + F[6], F[1] * x1 + F[4] * y1 + F[7]
    line1 = F[0] * x0 + F[1] * y0 + F[2], F[3] * x0 + F[4] * y0 + F[5]
    there = here = 0.0
    for k, (a, b) in enumerate((line0, line1)):
        u, v = (a * J[..., k, 0, i] + b * J[..., k, 1, i] for i in (0, 1))
        there, here = there + (u * u + v * v), here + (a * a + b * b)
    return _ratio(there, here)


def homography_stretch(H: Any, points: Any, J: Any) -> Any:
    """The same of Sampson's distance of a homography (9,), in the direction of the residual ``e = W x1 - (X, Y)``: of
    ``e^T C^-1 e``, C the covariance of e by unit noise of points, and of photographs' points. Arrays."""
    h, x = H.reshape(3, 3), points[2:].T
    X, Y, W = h[:, :2] @ points[:2] + h[:, 2:]
    e = W[:, None] * x - np.stack([X, Y], 1)
    by_points = np.stack([x[..., None] * h[2, :2] - h[:2, :2], W[:, None, None] * np.eye(2)], 1)
    squared = []
    for D in (by_points, by_points @ J):
        (a, b), (_, d) = np.moveaxis((D @ D.swapaxes(2, 3)).sum(1), 0, -1)
        squared.append((d * e[:, 0] ** 2 - 2 * b * e[:, 0] * e[:, 1] + a * e[:, 1] ** 2) / (a * d - b * b))
    return _ratio(*squared)


def _ratio(there: Any, here: Any) -> Any:
    none = (here == 0) | (there == 0)
    return (there + none) / (here + none)


def mean_stretch(J: Any, sqrt: Callable[[Any], Any] = np.sqrt) -> Any:
    """The same (...) in the geometric mean of all directions, of derivatives J (..., 2, 2, 2); where those of image 0
    are zero, as of exact points, in that of image 1 and none. sqrt: of its type."""
    a, b = (abs(J[..., k, 0, 0] * J[..., k, 1, 1] - J[..., k, 0, 1] * J[..., k, 1, 0]) for k in (0, 1))
    return sqrt(sqrt((a + b * (a == 0) / 4) * b))


def unit_frobenius(F: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """F divided by its Frobenius norm; the zero matrix stays zero, with finite gradients."""
    F = unit_largest(F)
    squared = torch.zeros_like(F[..., 0, 0])
    for element in F.flatten(-2).unbind(-1):
        squared = squared + element * element
    return F * inverse_root(squared)[..., None, None]


def epipolar_lines(F: Matrix, x0: Points) -> Float[Tensor, "*#batch n 3"]:
    """The lines (a, b, c) of x0 in image 1, ``a x + b y + c = 0`` with a^2 + b^2 = 1; pass ``F.mT`` for image 0.

    Where a = b = 0 (the epipole, or the line at infinity) the line is returned unscaled, as OpenCV does.

    Args:
        F: fundamental matrices (..., 3, 3), of any scale.
        x0: points (..., N, 2), px.

    Returns:
        Lines (..., N, 3) in pixels.
    """
    a, b, c = lines_through(unit_largest(F), x0)
    squared = a * a + b * b
    scale = torch.where(squared > 0, inverse_root(squared), 1.0)
    return torch.stack([a, b, c], -1) * scale[..., None]


def point_to_line(x: Points, line: Float[Tensor, "*#batch n 3"]) -> PerMatch:
    """Distance in pixels of each point to its line (a, b, c) of any scale; 0 where a = b = 0.

    Args:
        x: points (..., N, 2), px.
        line: lines (..., N, 3).

    Returns:
        (..., N), at least 0.
    """
    a, b, c = line.unbind(-1)
    return (a * x[..., 0] + b * x[..., 1] + c).abs() * inverse_root(a * a + b * b)


def algebraic(F: Matrix, x0: Points, x1: Points) -> PerMatch:
    """The signed algebraic residual ``x1^T F x0``, in units of F; arguments and shape as of `sampson`."""
    a, b, c = lines_through(F, x0)
    return a * x1[..., 0] + b * x1[..., 1] + c


def epipolar_distances(F: Matrix, x0: Points, x1: Points) -> tuple[PerMatch, PerMatch]:
    """Point-to-line distances in pixels: of x0 to the line ``F^T x1`` in image 0, of x1 to ``F x0`` in image 1.
    Arguments as of `sampson`. Two tensors (..., N), at least 0: in image 0, in image 1."""
    e, squared0, squared1 = residual_and_normals(F, x0, x1)
    return e.abs() * inverse_root(squared0), e.abs() * inverse_root(squared1)


def symmetric_mean(F: Matrix, x0: Points, x1: Points) -> PerMatch:
    """Mean of the two point-to-line distances, in pixels; arguments and shape as of `sampson`."""
    d0, d1 = epipolar_distances(F, x0, x1)
    return (d0 + d1) / 2


def symmetric_max(F: Matrix, x0: Points, x1: Points) -> PerMatch:
    """Larger of the two point-to-line distances, in pixels; arguments and shape as of `sampson`."""
    d0, d1 = epipolar_distances(F, x0, x1)
    return torch.maximum(d0, d1)


def symmetric_squared(F: Matrix, x0: Points, x1: Points) -> PerMatch:
    """Sum of the two squared point-to-line distances, in squared pixels (Hartley & Zisserman, eq. 11.10);
    arguments and shape as of `sampson`."""
    d0, d1 = epipolar_distances(F, x0, x1)
    return d0 * d0 + d1 * d1


def sampson(F: Matrix, x0: Points, x1: Points) -> PerMatch:
    """Sampson distance in pixels: |x1^T F x0| over the norm of its gradient (Hartley & Zisserman, eq. 11.9).

    Args:
        F: fundamental matrices (..., 3, 3), of any scale and sign.
        x0: points in image 0, (..., N, 2), px.
        x1: their matches in image 1, (..., N, 2), px.

    Returns:
        (..., N), at least 0.

    Example:
        >>> import torch
        >>> from fmtorch.geometry import sampson
        >>> F = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a sideways camera: matches are in one row
        >>> round(float(sampson(F, torch.tensor([[10.0, 20]]), torch.tensor([[5.0, 22]]))), 3)
        1.414
    """
    e, squared0, squared1 = residual_and_normals(F, x0, x1)
    return e.abs() * inverse_root(squared0 + squared1)


def sampson_squared(F: Matrix, x0: Points, x1: Points) -> PerMatch:
    """Squared Sampson distance, in squared pixels; arguments and shape as of `sampson`."""
    distance = sampson(F, x0, x1)
    return distance * distance


def residual_and_normals(F: Tensor, x0: Tensor, x1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x1^T F x0 and the squared norms of the normals of ``F^T x1`` and ``F x0``, all for one scaled F."""
    F = unit_largest(F)
    a1, b1, c1 = lines_through(F, x0)
    a0, b0, _ = lines_through(F.mT, x1)
    e = a1 * x1[..., 0] + b1 * x1[..., 1] + c1
    return e, a0 * a0 + b0 * b0, a1 * a1 + b1 * b1


def lines_through(F: Tensor, x: Tensor) -> list[Tensor]:
    """The three components of F (x, y, 1)."""
    u, v = x.unbind(-1)
    return [F[..., i, 0, None] * u + F[..., i, 1, None] * v + F[..., i, 2, None] for i in range(3)]


def inverse_root(squared: Tensor) -> Tensor:
    """1 / sqrt(squared), and 0 with zero gradient where squared = 0.
    On a CPU `rsqrt` rounds root and quotient correctly, one after the other, as `arithmetic.sqrt` and a division do."""
    positive = squared != 0  # NaN stays NaN
    return torch.where(positive, torch.where(positive, squared, 1.0).rsqrt(), 0.0)


def unit_largest(matrix: Tensor) -> Tensor:
    """A homogeneous matrix scaled so that squares neither under- nor overflow.
    The scale is a constant to autograd: what is computed from the matrix does not depend on it."""
    largest = matrix.detach().abs().amax((-2, -1), keepdim=True)
    return matrix / torch.where(largest == 0, 1.0, largest)


# Sampson distances component by component, with derivatives for fits

TINY = 1e-30  # squared slope of the epipolar constraint below which it is taken for this, in fits


def linearise(
    F: Float[Tensor, "9 p k"], points: Float[Tensor, "4 p n"], derivatives: bool = True
) -> tuple[Tensor, Float[Tensor, "p k n"], Float[Tensor, "p k n"], Float[Tensor, "p k n"]]:
    """The Sampson residual ``r = e / g`` and its Jacobian: g J (3, 3, p, k, n), then e, 1 / g^2, and r^2.
    ``g dr = x1^T dF x0 - (e / g^2) ((F x0)^T D dF x0 + x1^T dF D F^T x1)`` with ``D = diag(1, 1, 0)``: the sum of two
    products of a column and a row. points: x0, y0, x1, y1. Without derivatives the first is empty."""
    x0, x1 = (torch.cat([x, torch.ones_like(x[:1])])[:, :, None] for x in (points[:2], points[2:]))
    rows = F.reshape(3, 3, *F.shape[1:], 1)
    line1 = torch.addcmul(torch.addcmul(rows[:, 2], rows[:, 0], x0[0]), rows[:, 1], x0[1])  # F x0
    line0 = torch.addcmul(torch.addcmul(rows[2, :2], rows[0, :2], x1[0]), rows[1, :2], x1[1])  # F^T x1
    slope1 = line1[:2]
    e = torch.addcmul(torch.addcmul(line1[2], slope1[0], x1[0]), slope1[1], x1[1])
    a, b = torch.addcmul(slope1 * slope1, line0, line0)
    inverse = (a + b).clamp_min(TINY).reciprocal()
    c = e * inverse
    r2 = e * c
    if not derivatives:
        return e.new_empty(0), e, inverse, r2
    across1 = torch.cat([torch.addcmul(x1[:2], c, slope1, value=-1), torch.ones_like(e)[None]])  # x1 - c D F x0
    across0 = torch.cat([-c * line0, torch.zeros_like(e)[None]])  # -c D F^T x1
    return torch.addcmul(across1[:, None] * x0, x1[:, None], across0), e, inverse, r2


# Squared residuals of matches under a model, as scores take them of many models, and fits of one

SINGLES = 16  # float32 numbers of a row
load, fill = lanes(SINGLES)
MATCH = 6  # rows of SINGLES matches: x0, y0, x1, y1, scale, weight
INFINITE, ZERO = np.float32(math.inf), np.float32(0)
TINY32, TINY_OF_KERNEL = np.finfo(np.float32).tiny, float(np.finfo(np.float64).tiny)


class Residual(NamedTuple):
    """Three inner functions of one residual. name: unique, part of the names of the kernels that are made of it.
    of_lanes(f, x0, y0, x1, y1): squared residuals of SINGLES matches, or models, float32. of_match(f, x0, y0, x1, y1):
    the square of one, in the type of its arguments. within(f, x0, y0, x1, y1, limit): whether that is within a limit.
    """

    name: str
    of_lanes: Inner[..., Any]
    of_match: Inner[..., Any]
    within: Inner[..., Any]


@inner
def sampson_parts(f: Array, x0: Any, y0: Any, x1: Any, y1: Any) -> tuple[Any, Any]:
    """The epipolar error, and the square of its slope."""
    a0, b0 = f[0] * x0 + f[1] * y0 + f[2], f[3] * x0 + f[4] * y0 + f[5]
    e = f[6] * x0 + f[7] * y0 + f[8] + a0 * x1 + b0 * y1
    a1, b1 = f[0] * x1 + f[3] * y1 + f[6], f[1] * x1 + f[4] * y1 + f[7]
    return e, a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1


@inner
def _sampson_of_lanes(f: Any, x0: Any, y0: Any, x1: Any, y1: Any) -> Any:
    e, slope = sampson_parts(f, x0, y0, x1, y1)
    return e * e / where(slope > TINY32, slope, TINY32)


@inner
def _sampson_of_match(f: Array, x0: Any, y0: Any, x1: Any, y1: Any) -> Any:
    e, slope = sampson_parts(f, x0, y0, x1, y1)
    return e * e / (slope if slope > TINY_OF_KERNEL else TINY_OF_KERNEL)


@inner
def _sampson_within(f: Array, x0: Any, y0: Any, x1: Any, y1: Any, limit: Any) -> Any:
    e, slope = sampson_parts(f, x0, y0, x1, y1)
    return e * e <= limit * slope


SAMPSON = Residual("sampson", _sampson_of_lanes, _sampson_of_match, _sampson_within)
"""The Sampson distance of a fundamental matrix (Hartley & Zisserman 2004, 11.4.3)."""


@inner
def _homography(h: Array, x: Any, y: Any, u: Any, v: Any) -> tuple[Any, Any, Any]:
    """Of a match W, positive before the horizon, and numerator and denominator of its squared distance."""
    w = h[6] * x + h[7] * y + h[8]
    e, f = h[0] * x + h[1] * y + h[2] - u * w, h[3] * x + h[4] * y + h[5] - v * w
    a, b, c, d = h[0] - u * h[6], h[1] - u * h[7], h[3] - v * h[6], h[4] - v * h[7]
    p, q, area, w2 = c * e - a * f, d * e - b * f, a * d - b * c, w * w
    return w, w2 * (e * e + f * f) + p * p + q * q, area * area + w2 * (a * a + b * b + c * c + d * d + w2)


@inner
def _homography_of_lanes(h: Any, x: Any, y: Any, u: Any, v: Any) -> Any:
    w, r2, by = _homography(h, x, y, u, v)
    return where(w > ZERO, r2 / where(by > TINY32, by, TINY32), INFINITE)


@inner
def _homography_of_match(h: Array, x: Any, y: Any, u: Any, v: Any) -> Any:
    w, r2, by = _homography(h, x, y, u, v)
    return r2 / by if w > 0 else w - w + math.inf


@inner
def _homography_within(h: Array, x: Any, y: Any, u: Any, v: Any, limit: Any) -> Any:
    return _homography_of_match(h, x, y, u, v) <= limit


HOMOGRAPHY = Residual("homography", _homography_of_lanes, _homography_of_match, _homography_within)
"""The Sampson distance of a homography (4.2.6); infinite behind its horizon (`homography_refine`)."""
