"""The seven-point algorithm."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.minimal import seven_point_components
from fmtorch.geometry.normalize import canonical, denormalize_fundamental, normalize_points


def seven_point(
    x0: Float[Tensor, "*batch 7 2"], x1: Float[Tensor, "*batch 7 2"]
) -> tuple[Float[Tensor, "*batch 3 3 3"], Bool[Tensor, "*batch 3"]]:
    """The one to three fundamental matrices of seven correspondences, and which slots hold one (the others are zero).

    Hartley and Zisserman, Multiple View Geometry, 11.1.2, on normalised points, in float64. F has unit Frobenius norm
    and its largest entry positive; it is returned in x0's type. Degenerate samples (repeated points, dependent
    equations, anything not finite) have no valid slot. Differentiable; the gradient stays finite at double roots.

    Args:
        x0: points in image 0, (..., 7, 2).
        x1: their matches in image 1, (..., 7, 2).

    Returns:
        F (..., 3, 3, 3), three slots of a matrix each, and valid (..., 3).

    Example:
        >>> import torch
        >>> from fmtorch.geometry import sampson, seven_point
        >>> generator = torch.Generator().manual_seed(0)
        >>> x0, x1 = torch.rand(2, 7, 2, generator=generator, dtype=torch.float64) * 500
        >>> F, valid = seven_point(x0, x1)
        >>> bool((sampson(F[valid], x0, x1) < 1e-6).all())
        True
    """
    finite = (x0.isfinite() & x1.isfinite()).all(-1).all(-1)
    x0d, x1d = (torch.where(finite[..., None, None], x, 0.0).to(torch.float64) for x in (x0, x1))
    x0n, T0 = normalize_points(x0d)
    x1n, T1 = normalize_points(x1d)
    points = torch.cat([x0n, x1n], -1).movedim((-1, -2), (0, 1)).contiguous()
    components, slots = seven_point_components(points)
    F = components.movedim((1, 0), (-2, -1)).reshape(*x0.shape[:-2], 3, 3, 3)
    F = canonical(denormalize_fundamental(F, T0[..., None, :, :], T1[..., None, :, :]))
    valid = slots.movedim(0, -1) & finite[..., None]
    return torch.where(valid[..., None, None], F, 0.0).to(x0.dtype), valid
