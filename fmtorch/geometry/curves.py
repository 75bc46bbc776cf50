"""Space-filling curves: an order of points in which what is near in space is mostly near in the order."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_BITS = 15  # of each coordinate
_AFTER_ALL = 1 << 31  # a code beyond those of all points
_SPREADING = ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555))


def curve_order(
    points: Float[Tensor, "2 b n"], mask: Bool[Tensor, "b n"], shift: float | Float[Tensor, "b 1"]
) -> Int[Tensor, "b n"]:
    """The order of the points in the mask along a Morton curve over a shifted grid; the others last.

    shift: of the grid, between 0 and 1, in thirds of the curve's extent, which is 1.5
    times that of the points along the axis on which they extend furthest.
    """
    if mask.shape[-1] == 0:
        return torch.zeros_like(mask, dtype=torch.int64)
    low = torch.where(mask, points, torch.inf).amin(-1, keepdim=True)
    extent = (torch.where(mask, points, -torch.inf).amax(-1, keepdim=True) - low).amax(0).clamp_min(1e-6)
    cell = (torch.where(mask, (points - low) / extent, 0) * 2 + shift) / 3 * ((1 << _BITS) - 1)
    column, row = _spread(cell.to(torch.int64))
    code = torch.where(mask, column | (row << 1), _AFTER_ALL)
    return torch.argsort(code, dim=-1, stable=True)


def curve_orders(
    points0: Float[Tensor, "2 b n"],
    points1: Float[Tensor, "2 b n"],
    mask: Bool[Tensor, "b n"],
    curves: Sequence[tuple[float, float]],
) -> Int[Tensor, "c b n"]:
    """`curve_order` of the points in image 0, then in image 1, along curves of these (shift, rotation in radians)."""
    planes = [rotated(points, angle) for points in (points0, points1) for _, angle in curves]
    b = len(mask)
    shift = points0.new_tensor([s for s, _ in curves] * 2).repeat_interleave(b)[:, None]
    return curve_order(torch.cat(planes, 1), mask.repeat(len(planes), 1), shift).reshape(len(planes), *mask.shape)


def rotated(points: Float[Tensor, "2 b n"], angle: float) -> Float[Tensor, "2 b n"]:
    """Points of the plane turned by an angle, in radians."""
    x, y = points
    return torch.stack([math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y])


def _spread(v: Int[Tensor, "2 b n"]) -> Int[Tensor, "2 b n"]:
    """The bits of numbers moved to the even positions."""
    for step, pattern in _SPREADING:
        v = (v | (v << step)) & pattern
    return v
