"""Epipolar lines, and the distances between points and them.

Image 0 comes first: ``x1^T F x0 = 0``. Points are (..., N, 2) in pixels, matrices (..., 3, 3) of any scale and sign;
leading dimensions broadcast. Only additions, multiplications, divisions and square roots of single elements are used,
all correctly rounded, so a result is bit-equal whatever stands beside it in the batch. Where an image point falls on
the epipole its line is undefined: its normal is then zero, and distances and gradients to it are 0, never NaN.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def unit_frobenius(F: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """F divided by its Frobenius norm; the zero matrix stays zero, with finite gradients."""
    F = unit_largest(F)
    squared = torch.zeros_like(F[..., 0, 0])
    for element in F.flatten(-2).unbind(-1):
        squared = squared + element * element
    return F * inverse_root(squared)[..., None, None]


def epipolar_lines(F: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"]) -> Float[Tensor, "*#batch n 3"]:
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


def point_to_line(x: Float[Tensor, "*#batch n 2"], line: Float[Tensor, "*#batch n 3"]) -> Float[Tensor, "*#batch n"]:
    """Distance in pixels of each point to its line (a, b, c) of any scale; 0 where a = b = 0.

    Args:
        x: points (..., N, 2), px.
        line: lines (..., N, 3).

    Returns:
        (..., N), at least 0.
    """
    a, b, c = line.unbind(-1)
    return (a * x[..., 0] + b * x[..., 1] + c).abs() * inverse_root(a * a + b * b)


def algebraic(
    F: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*#batch n"]:
    """The signed algebraic residual ``x1^T F x0``, in units of F.

    Arguments and shape as of `sampson`.
    """
    a, b, c = lines_through(F, x0)
    return a * x1[..., 0] + b * x1[..., 1] + c


def epipolar_distances(
    F: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"]
) -> tuple[Float[Tensor, "*#batch n"], Float[Tensor, "*#batch n"]]:
    """Point-to-line distances in pixels: of x0 to the line ``F^T x1`` in image 0, of x1 to ``F x0`` in image 1.

    Args:
        F: fundamental matrices (..., 3, 3), of any scale and sign.
        x0: points in image 0, (..., N, 2), px.
        x1: their matches in image 1, (..., N, 2), px.

    Returns:
        Two tensors (..., N), at least 0: in image 0, in image 1.
    """
    e, squared0, squared1 = residual_and_normals(F, x0, x1)
    return e.abs() * inverse_root(squared0), e.abs() * inverse_root(squared1)


def symmetric_mean(
    F: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*#batch n"]:
    """Mean of the two point-to-line distances, in pixels.

    Arguments and shape as of `sampson`.
    """
    d0, d1 = epipolar_distances(F, x0, x1)
    return (d0 + d1) / 2


def symmetric_max(
    F: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*#batch n"]:
    """Larger of the two point-to-line distances, in pixels.

    Arguments and shape as of `sampson`.
    """
    d0, d1 = epipolar_distances(F, x0, x1)
    return torch.maximum(d0, d1)


def symmetric_squared(
    F: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*#batch n"]:
    """Sum of the two squared point-to-line distances, in squared pixels (Hartley & Zisserman, eq. 11.10).

    Arguments and shape as of `sampson`.
    """
    d0, d1 = epipolar_distances(F, x0, x1)
    return d0 * d0 + d1 * d1


def sampson(
    F: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*#batch n"]:
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


def sampson_squared(
    F: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"]
) -> Float[Tensor, "*#batch n"]:
    """Squared Sampson distance, in squared pixels.

    Arguments and shape as of `sampson`.
    """
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

    On a CPU `rsqrt` rounds root and quotient correctly, one after the other, as `arithmetic.sqrt` and a division do.
    """
    positive = squared != 0  # NaN stays NaN
    return torch.where(positive, torch.where(positive, squared, 1.0).rsqrt(), 0.0)


def unit_largest(matrix: Tensor) -> Tensor:
    """A homogeneous matrix scaled so that squares neither under- nor overflow.

    The scale is a constant to autograd: what is computed from the matrix does not depend on it.
    """
    largest = matrix.detach().abs().amax((-2, -1), keepdim=True)
    return matrix / torch.where(largest == 0, 1.0, largest)
