"""Space-filling curves: an order of points in which what is near in space is mostly near in the order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.jit.kernel import Array, inner

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


# `curves` for the points of one pair, compiled


_CELLS = (1 << _BITS) - 1
_DIGIT = 10  # bits sorted by at a time
_PLACES = 1 << _DIGIT


@inner
def curve_order_kernel(x: Array, y: Array, shift: float, cosine: float, sine: float, order: Array) -> None:
    """`curves.curve_order` of the turned points x, y (n,) -> order (n,) i8: the same numbers.

    shift, cosine, sine: of the grid and of the rotation, in the type of the points.
    """
    n = len(x)
    if n == 0:
        return
    u, v = np.empty_like(x), np.empty_like(y)
    for i in range(n):
        u[i] = cosine * x[i] - sine * y[i]
        v[i] = sine * x[i] + cosine * y[i]
    low_u, high_u, low_v, high_v = u[0], u[0], v[0], v[0]
    for i in range(n):
        low_u, high_u = min(low_u, u[i]), max(high_u, u[i])
        low_v, high_v = min(low_v, v[i]), max(high_v, v[i])
    kind = x.dtype.type
    extent = max(max(high_u - low_u, high_v - low_v), kind(1e-6))
    two, three, cells = kind(2), kind(3), kind(_CELLS)  # of the points' type, or the products would be float64
    key, sorted_key = np.empty(n, np.uint64), np.empty(n, np.uint64)
    for i in range(n):
        column = np.int64(((u[i] - low_u) / extent * two + shift) / three * cells)
        row = np.int64(((v[i] - low_v) / extent * two + shift) / three * cells)
        key[i] = ((_spread_kernel(column) | (_spread_kernel(row) << np.uint64(1))) << np.uint64(32)) | np.uint64(i)
    for digit in range(3):
        _sort_by_digit(key, sorted_key, np.uint64(32 + _DIGIT * digit))
        key, sorted_key = sorted_key, key
    for i in range(n):
        order[i] = np.int64(key[i] & np.uint64(0xFFFFFFFF))


@inner
def _spread_kernel(cell: Any) -> Any:
    """The 15 bits of a cell's number moved to the even positions."""
    v = np.uint64(cell) & np.uint64(_CELLS)
    v = (v | (v << np.uint64(8))) & np.uint64(0x00FF00FF)
    v = (v | (v << np.uint64(4))) & np.uint64(0x0F0F0F0F)
    v = (v | (v << np.uint64(2))) & np.uint64(0x33333333)
    return (v | (v << np.uint64(1))) & np.uint64(0x55555555)


@inner
def _sort_by_digit(key: Array, out: Array, low: Any) -> None:
    """Keys (n,) in the order of the ten bits from bit `low` on, equal ones as they stood -> out (n,)."""
    place = np.zeros(_PLACES + 1, np.int64)
    for i in range(len(key)):
        place[((key[i] >> low) & np.uint64(_PLACES - 1)) + np.uint64(1)] += 1
    for digit in range(_PLACES):
        place[digit + 1] += place[digit]
    for i in range(len(key)):
        digit = (key[i] >> low) & np.uint64(_PLACES - 1)
        out[place[digit]] = key[i]
        place[digit] += 1
