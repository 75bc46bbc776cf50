"""The normalised, weighted eight-point algorithm."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import stable_sum
from fmtorch.geometry.eigenvector import smallest_eigenvector
from fmtorch.geometry.normalize import canonical, denormalize_fundamental, normalize_points
from fmtorch.geometry.rank2 import nearest_rank2


def eight_point(
    x0: Float[Tensor, "*batch n 2"],
    x1: Float[Tensor, "*batch n 2"],
    weight: Float[Tensor, "*batch n"] | None = None,
    mask: Bool[Tensor, "*batch n"] | None = None,
) -> tuple[Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:
    """The fundamental matrix of N >= 8 correspondences by weighted linear least squares, and whether it is valid.

    Points are normalised (Hartley, PAMI 1997; with the weights, so that a point of weight zero is as good as masked),
    F is the smallest eigenvector of M = sum w a a^T, made rank two, denormalised, of unit Frobenius norm with its
    largest entry positive. Differentiable in points and weights (not in a root of the weights, so also at zero).
    Computed in float64, returned in x0's type.

    Args:
        x0: points of image 0, pixels.
        x1: their matches in image 1.
        weight: of each match, not negative, any scale; 1 by default.
        mask: True for a real match; all by default.

    Returns:
        F, and whether it is valid. Invalid (F = 0): fewer than eight independent equations (too few points, coincident
        or collinear ones, an exact plane), or anything not finite, or a negative weight, among the unmasked points. The
        result has the same bits in any batch and with any padding.

    Example:
        >>> import torch
        >>> from fmtorch.geometry import eight_point, sampson
        >>> generator = torch.Generator().manual_seed(0)
        >>> X = torch.rand(20, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 2.0])
        >>> x0 = 500 * X[:, :2] / X[:, 2:]                       # one camera, and one moved to the right and back
        >>> X1 = X + torch.tensor([-0.5, 0.0, 0.2])
        >>> x1 = 500 * X1[:, :2] / X1[:, 2:]
        >>> F, valid = eight_point(x0, x1)
        >>> bool(valid), bool((sampson(F, x0, x1) < 1e-6).all())
        (True, True)
    """
    F, valid = fundamental_of(NormalEquations.of(x0, x1, weight, mask))
    return F.to(x0.dtype), valid


class NormalEquations(NamedTuple):
    """What the eight-point algorithm needs to know of a set of matches, however many these are.

    M: the sum of w a a^T over normalised matches. T0, T1: the similarities that normalise the points. valid: whether
    everything was finite.
    """

    M: Float[Tensor, "*batch 9 9"]
    T0: Float[Tensor, "*batch 3 3"]
    T1: Float[Tensor, "*batch 3 3"]
    valid: Bool[Tensor, "*batch"]

    @classmethod
    def of(cls, x0: Tensor, x1: Tensor, weight: Tensor | None = None, mask: Tensor | None = None) -> NormalEquations:
        """Arguments as of `eight_point`."""
        x0d, x1d, w, valid = finite_matches(x0, x1, weight, mask)
        x0n, T0 = normalize_points(x0d, weight=w)
        x1n, T1 = normalize_points(x1d, weight=w)
        return cls(normal_matrix(x0n, x1n, w), T0, T1, valid)


def fundamental_of(equations: NormalEquations) -> tuple[Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:
    """The fundamental matrices, float64, and which are valid, as of `eight_point`."""
    f, determined = smallest_eigenvector(equations.M)
    linear = f.reshape(*f.shape[:-1], 3, 3)
    F = canonical(denormalize_fundamental(nearest_rank2(linear), equations.T0, equations.T1))
    valid = equations.valid & determined & (F.detach() != 0).any(-1).any(-1)
    return torch.where(valid[..., None, None], F, 0.0), valid


def linear_fundamental(
    x0: Float[Tensor, "*points n 2"], x1: Float[Tensor, "*points n 2"], weight: Float[Tensor, "*batch n"]
) -> tuple[Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:
    """The F of unit norm, of any rank, that minimises sum w (x1^T F x0)^2; False where it is not determined.

    Arguments as of `normal_matrix`.
    """
    f, determined = smallest_eigenvector(normal_matrix(x0, x1, weight))
    return f.reshape(*f.shape[:-1], 3, 3), determined


def normal_matrix(
    x0: Float[Tensor, "*points n 2"], x1: Float[Tensor, "*points n 2"], weight: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch 9 9"]:
    """The sum of w a a^T, with a . vec(F) = x1^T F x0.

    Expects normalised float64 points, finite, with weight zero for those that do not count. The points' leading shape
    broadcasts against that of the weights.
    """
    # a = x1 (x) x0, so M holds the sums of w (x1 x1^T) (x) (x0 x0^T): 6 x 6 different ones, in parts that fit a cache.
    p0, p1 = _products(x0), weight[..., None, :] * _products(x1)
    rows = [stable_sum(part[..., :, None, :] * p0[..., None, :, :], -1) for part in p1.chunk(3, -2)]
    sums = torch.cat(rows, -2)
    M: Tensor = sums[..., _PRODUCT_INDEX[:, None, :, None], _PRODUCT_INDEX[None, :, None, :]]
    return M.reshape(*sums.shape[:-2], 9, 9)


_PRODUCT_INDEX = torch.tensor([[0, 1, 3], [1, 2, 4], [3, 4, 5]])


def _products(x: Tensor) -> Tensor:
    """The different entries of (x, y, 1) (x, y, 1)^T: (*batch, 6, n)."""
    x, y = x.unbind(-1)
    return torch.stack([x * x, x * y, y * y, x, y, torch.ones_like(x)], -2)


def finite_matches(
    x0: Tensor, x1: Tensor, weight: Tensor | None, mask: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points and weights in float64, zero where they do not count; False for a set in which one cannot be used."""
    w = torch.ones_like(x0[..., 0]) if weight is None else weight
    good = (x0.isfinite() & x1.isfinite()).all(-1) & w.isfinite() & (w >= 0)
    keep = good if mask is None else good & mask
    valid = (good if mask is None else good | ~mask).all(-1)
    x0d, x1d = (torch.where(keep[..., None], x, 0.0).to(torch.float64) for x in (x0, x1))
    wd = torch.where(keep, w, 0.0).to(torch.float64)
    largest = wd.detach().amax(-1, keepdim=True) if wd.shape[-1] else wd.new_ones(*wd.shape[:-1], 1)
    return x0d, x1d, wd / torch.where(largest > 0, largest, 1.0), valid
