"""The seven-point algorithm."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import cofactors
from fmtorch.geometry.normalize import canonical, denormalize_fundamental, normalize_points
from fmtorch.geometry.seven_point_kernels import all_seven_point

GAP = 1e-7  # singular values below it have their gradient held finite


def seven_point(
    x0: Float[Tensor, "*batch 7 2"], x1: Float[Tensor, "*batch 7 2"]
) -> tuple[Float[Tensor, "*batch 3 3 3"], Bool[Tensor, "*batch 3"]]:
    """The one to three fundamental matrices of seven correspondences, and which slots hold one (the others are zero).

    Hartley and Zisserman, Multiple View Geometry, 11.1.2, on normalised points, in float64. F has unit Frobenius norm
    and its largest entry positive; it is returned in x0's type. Degenerate samples (repeated points, dependent
    equations, anything not finite) have no valid slot. Differentiable; the gradient stays finite at double roots.
    Values are computed on the CPU.

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
    F, slots = _solved(x0n, x1n)
    F = canonical(denormalize_fundamental(F, T0[..., None, :, :], T1[..., None, :, :]))
    valid = slots & finite[..., None]
    return torch.where(valid[..., None, None], F, 0.0).to(x0.dtype), valid


def _solved(
    x0: Float[Tensor, "*batch 7 2"], x1: Float[Tensor, "*batch 7 2"]
) -> tuple[Float[Tensor, "*batch 3 3 3"], Bool[Tensor, "*batch 3"]]:
    """The models of normalised samples, by the kernel, on the CPU; attached to the graph of the points."""
    points = torch.cat([x0, x1], -1).detach().cpu().reshape(-1, 4).T.contiguous().numpy()
    sample = np.ascontiguousarray(np.arange(points.shape[1]).reshape(-1, 7).T)
    F, valid = np.empty((sample.shape[1], 3, 9)), np.empty((sample.shape[1], 3), np.bool_)
    all_seven_point(points, sample, F, valid)
    models = torch.from_numpy(F).to(x0.device).reshape(*x0.shape[:-2], 3, 3, 3)
    slots = torch.from_numpy(valid).to(x0.device).reshape(*x0.shape[:-2], 3)
    if torch.is_grad_enabled() and (x0.requires_grad or x1.requires_grad):
        models = _attached(models, x0, x1)
    return models, slots


def _attached(F: Float[Tensor, "*batch 3 3 3"], x0: Tensor, x1: Tensor) -> Float[Tensor, "*batch 3 3 3"]:
    """F, on no graph, attached to that of the points by the implicit function theorem; zero matrices have no gradient.

    The nine entries are determined by the seven equations ``x1^T F x0 = 0``, ``det F = 0`` and the norm. Where roots
    meet, singular values s of these constraints' Jacobian are inverted as ``s / (s^2 + GAP^2)``.
    """
    h0, h1 = (torch.cat([x, torch.ones_like(x[..., :1])], -1)[..., None, :, :] for x in (x0, x1))
    error = ((h1 @ F) * h0).sum(-1)
    with torch.no_grad():
        equations = (h1[..., :, None] * h0[..., None, :]).flatten(-2).expand(*F.shape[:-2], 7, 9)
        rank = cofactors(F.movedim((-2, -1), (0, 1))).movedim((0, 1), (-2, -1))
        U, s, Vh = torch.linalg.svd(
            torch.cat([equations, rank.flatten(-2)[..., None, :], F.flatten(-2)[..., None, :]], -2)
        )
        inverse = (Vh.mT * (s / (s * s + GAP * GAP))[..., None, :]) @ U.mT
        inverse = torch.where((F != 0).flatten(-2).any(-1)[..., None, None], inverse[..., :7], 0)
    return F - (inverse @ (error - error.detach())[..., None]).reshape(F.shape)
