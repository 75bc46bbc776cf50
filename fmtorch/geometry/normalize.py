"""Normalisation of image points before linear estimation, and of fundamental matrices after it."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import component_sum, matmul3, sqrt, stable_sum
from fmtorch.geometry.epipolar import unit_frobenius


def normalize_points(
    x: Float[Tensor, "*batch n 2"],
    mask: Bool[Tensor, "*batch n"] | None = None,
    weight: Float[Tensor, "*batch n"] | None = None,
) -> tuple[Float[Tensor, "*batch n 2"], Float[Tensor, "*batch 3 3"]]:
    """Points moved to zero mean and mean distance sqrt(2), and the similarity T that does it (x_n = T x).

    Hartley, In Defense of the Eight-Point Algorithm, PAMI 1997. Means are over the points in `mask`, weighted by
    `weight`. Masked slots come out zero. Coincident points (or none) are centred and keep their scale.

    Args:
        x: points (..., N, 2).
        mask: (..., N), True for the points that count; all by default.
        weight: (..., N), at least 0; 1 by default.

    Returns:
        The points moved (..., N, 2), and T (..., 3, 3).
    """
    x, w = _clean(x, mask, weight)
    centroid = _mean(x, w)
    centred = x - centroid[..., None, :]
    scale = _scale(_mean_distance(centred, w), centroid)
    return _apply(centred, mask, scale), _similarity(centroid, scale)


def normalize_pair(
    x0: Float[Tensor, "*batch n 2"],
    x1: Float[Tensor, "*batch n 2"],
    mask: Bool[Tensor, "*batch n"] | None = None,
) -> tuple[
    Float[Tensor, "*batch n 2"],
    Float[Tensor, "*batch n 2"],
    Float[Tensor, "*batch 3 3"],
    Float[Tensor, "*batch 3 3"],
]:
    """Points of both images centred each on its own, with one common scale: x0_n, x1_n, T0, T1.

    The mean distance to the centroid, over both images, becomes sqrt(2). Distances keep their proportions between the
    images, so a threshold in pixels stays one number. Masked slots come out zero; coincident points keep their scale.

    Args:
        x0: points in image 0, (..., N, 2), px.
        x1: their matches in image 1, (..., N, 2), px.
        mask: (..., N), True for the matches that count; all by default.

    Returns:
        The points moved, (..., N, 2) each, and the similarities (..., 3, 3) that move them.
    """
    (x0, w), (x1, _) = _clean(x0, mask, None), _clean(x1, mask, None)
    c0, c1 = _mean(x0, w), _mean(x1, w)
    x0, x1 = x0 - c0[..., None, :], x1 - c1[..., None, :]
    distance = (_mean_distance(x0, w) + _mean_distance(x1, w)) / 2
    scale = _scale(distance, torch.maximum(c0.abs(), c1.abs()))
    return _apply(x0, mask, scale), _apply(x1, mask, scale), _similarity(c0, scale), _similarity(c1, scale)


def denormalize_fundamental(
    F: Float[Tensor, "*#batch 3 3"], T0: Float[Tensor, "*#batch 3 3"], T1: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*#batch 3 3"]:
    """The fundamental matrix T1^T F T0 of points x, given F of the normalised points T x; leading shapes broadcast.

    Args:
        F: of normalised points, (..., 3, 3).
        T0: the similarity (..., 3, 3) that normalised the points of image 0.
        T1: that of image 1.

    Returns:
        (..., 3, 3), not scaled.
    """
    return matmul3(matmul3(T1.mT, F), T0)


def canonical(F: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """F scaled to unit Frobenius norm with its entry of largest magnitude (the first of equals) positive.

    A zero matrix stays zero, with zero gradient.
    """
    flat = F.detach().reshape(*F.shape[:-2], 9)
    peak = torch.gather(flat, -1, flat.abs().argmax(-1, keepdim=True))[..., None]
    return unit_frobenius(F) * torch.copysign(torch.ones_like(peak), peak)


def _clean(x: Tensor, mask: Tensor | None, weight: Tensor | None) -> tuple[Tensor, Tensor]:
    """Points and weights with zeros in the masked slots."""
    w = torch.ones_like(x[..., 0]) if weight is None else weight
    if mask is None:
        return x, w
    return torch.where(mask[..., None], x, 0.0), torch.where(mask, w, 0.0)


def _mean(x: Tensor, w: Tensor) -> Tensor:
    total = stable_sum(w, -1)
    return stable_sum(w[..., None] * x, -2) / torch.where(total > 0, total, 1.0)[..., None]


def _mean_distance(centred: Tensor, w: Tensor) -> Tensor:
    """The mean distance to the origin; a point at the origin has gradient zero."""
    d2 = component_sum(centred * centred, -1)
    away = d2 > 0
    distance = torch.where(away, sqrt(torch.where(away, d2, 1.0)), 0.0)
    total = stable_sum(w, -1)
    return stable_sum(w * distance, -1) / torch.where(total > 0, total, 1.0)


def _scale(distance: Tensor, centroid: Tensor) -> Tensor:
    """sqrt(2) / distance; 1 where the distance is no more than the rounding error of the centroid."""
    rounding = 4 * torch.finfo(distance.dtype).eps * centroid.detach().abs().amax(-1)
    spread = distance > rounding
    return torch.where(spread, 2**0.5 / torch.where(spread, distance, 1.0), 1.0)


def _apply(centred: Tensor, mask: Tensor | None, scale: Tensor) -> Tensor:
    scaled = centred * scale[..., None, None]
    return scaled if mask is None else torch.where(mask[..., None], scaled, 0.0)


def _similarity(centroid: Tensor, scale: Tensor) -> Tensor:
    zero, ones = torch.zeros_like(scale), torch.ones_like(scale)
    tx, ty = (-scale[..., None] * centroid).unbind(-1)
    rows = [scale, zero, tx, zero, scale, ty, zero, zero, ones]
    return torch.stack(rows, -1).reshape(*scale.shape, 3, 3)
