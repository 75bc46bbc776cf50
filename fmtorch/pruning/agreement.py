"""When two neighbouring matches agree: what `frame_consistency` and `position_consistency` have in common.

Neighbours are taken along space-filling curves in both images. The agreement is computed in float32 by kernels, which
take the numbers whose names end in 32; its gradient is that of the same definition in tensors.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.compiling.arrays import Array, B1x1, F4x2, I8x2
from fmtorch.compiling.batches import for_each_pair
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.geometry.arithmetic import component_sum, sqrt
from fmtorch.geometry.curves_kernels import curve_order

WINDOW = 8  # neighbours before and after each match along each curve
CURVES = ((0.0, 0.0), (0.5, math.pi / 4))  # shift of the grid (in thirds of the extent) and rotation of each curve
TOLERANCE = 0.25  # relative prediction error at which agreement falls to about 1/e
SHARPNESS = TOLERANCE**-2 / 8
NOISE = 4.0  # px, keeps close neighbours from being judged by their localisation noise
WORST_RATIO, MIN_VOTE = 0.85, 0.02  # a neighbour votes with WORST_RATIO - ratio, at least MIN_VOTE
MIN_SQUARE, MIN_VOTES = 1e-12, float(np.finfo(np.float32).tiny)  # keep a root's gradient and a quotient finite
FARTHEST = 1e15  # px; a match beyond is none: its squares could overflow

CURVES32 = np.array([(shift, math.cos(angle), math.sin(angle)) for shift, angle in CURVES], np.float32)
SHARPNESS32, NOISE32, FARTHEST32 = np.float32(SHARPNESS), np.float32(NOISE), np.float32(FARTHEST)
WORST_RATIO32, MIN_VOTE32 = np.float32(WORST_RATIO), np.float32(MIN_VOTE)
MIN_SQUARE32, MIN_VOTES32, ONE32 = np.float32(MIN_SQUARE), np.float32(MIN_VOTES), np.float32(1)


@inner
def curve_orders(rows: Array, orders: Array) -> None:
    """The order of matches (x0, y0, x1, y1, ...) along each curve, first of image 0, then of image 1 -> (c, m)."""
    m = orders.shape[1]
    for o in range(len(orders)):
        image, curve = o // len(CURVES32), o % len(CURVES32)
        curve_order(
            rows[2 * image, :m], rows[2 * image + 1, :m], CURVES32[curve, 0], CURVES32[curve, 1], CURVES32[curve, 2],
            orders[o],
        )  # fmt: skip


@inner
def put_in_order(rows: Array, order: Array, along: Array) -> None:
    """Columns of rows (d, n) in the order (m,) -> along (d, m)."""
    for k in range(len(rows)):
        for i in range(len(order)):
            along[k, i] = rows[k, order[i]]


@inner
def add_products(agree: Array, vote: Array, count: int, total: Array, votes: Array) -> None:
    """Adds so many agreeing votes to the totals, and the votes."""
    for i in range(count):
        total[i] += agree[i] * vote[i]
    for i in range(count):
        votes[i] += vote[i]


@kernel
def slots_along_curves(x0: F4x2, x1: F4x2, mask: B1x1, out: I8x2) -> None:
    """The slots of the matches in the mask along each curve, those of the others last -> out (c, n)."""
    n, m, last = len(mask), 0, len(mask)
    rows, slot = np.empty((4, n), x0.dtype), np.empty(n, np.int64)
    for i in range(n):
        if mask[i]:
            rows[0, m], rows[1, m], rows[2, m], rows[3, m], slot[m] = x0[i, 0], x0[i, 1], x1[i, 0], x1[i, 1], i
            m += 1
        else:
            last -= 1
            for o in range(len(out)):
                out[o, last] = i
    orders = np.empty((len(out), m), np.int64)
    curve_orders(rows, orders)
    for o in range(len(out)):
        for k in range(m):
            out[o, k] = slot[orders[o, k]]


def votes_of(quality: Float[Tensor, "b n"] | None, like: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
    """What the vote of each match counts."""
    return torch.ones_like(like) if quality is None else (WORST_RATIO - quality).clamp_min(MIN_VOTE)


def with_gradient(
    agreement: Float[Tensor, "b n"],
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    maps: Float[Tensor, "b n 2 2"],
    vote: Float[Tensor, "b n"],
    mask: Bool[Tensor, "b n"],
) -> Float[Tensor, "b n"]:
    """The agreement, attached to the graph of points, maps from image 0 to 1 and votes; the curves are constants."""
    S = maps.flatten(2).unbind(-1)
    scale = sqrt((S[0] * S[3] - S[1] * S[2]).abs())
    rows = torch.stack([*x0.unbind(-1), *x1.unbind(-1), *S, scale, vote])
    mask = mask & (rows.abs() < FARTHEST).all(0)
    rows = torch.where(mask, rows, 0)
    out = torch.empty(len(mask), 2 * len(CURVES), mask.shape[1], dtype=torch.int64)
    orders = for_each_pair(slots_along_curves, (x0, x1, mask), out=out).movedim(1, 0)
    defined = _agreement(rows, orders)
    return agreement + torch.where(mask & torch.isfinite(defined), defined - defined.detach(), 0)


def _agreement(rows: Float[Tensor, "10 b n"], orders: Int[Tensor, "c b n"]) -> Float[Tensor, "b n"]:
    """The agreement of matches x0, y0, x1, y1, map, scale, vote along all curves; those of no vote do not count."""
    along = rows[:, None].expand(-1, len(orders), -1, -1).gather(3, orders.expand(len(rows), -1, -1, -1))
    near = torch.nn.functional.pad(along, (WINDOW, WINDOW)).unfold(3, along.shape[3], 1)  # (10, c, b, 17, n), no copy
    rows = along[:, :, :, None]
    dx, dy, ux, uy = near[:4] - rows[:4]
    own, other = (
        (S[0] * dx + S[1] * dy - ux).square() + (S[2] * dx + S[3] * dy - uy).square() for S in (rows[4:8], near[4:8])
    )
    length0, length1 = (sqrt(x.square() + y.square() + MIN_SQUARE) for x, y in ((dx, dy), (ux, uy)))
    length = length0 * rows[8] + length1 + NOISE
    agree = (1 + torch.maximum(own, other) / length.square() * SHARPNESS) ** -8
    votes = torch.stack([agree * near[9], near[9].expand_as(agree)])
    votes = component_sum(torch.cat([votes[..., :WINDOW, :], votes[..., WINDOW + 1 :, :]], -2), -2)  # others' alone
    in_slots = torch.zeros_like(votes).scatter(3, orders.expand(2, -1, -1, -1), votes)
    agreement, total = component_sum(in_slots, 1)
    return agreement / total.clamp_min(torch.finfo(total.dtype).tiny)
