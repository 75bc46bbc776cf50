"""P(inlier) from points alone: does each match move as its neighbours do?

The pair's common turn and change of scale are found first, so that the images may be rotated and zoomed; then each
match is compared with its neighbours along space-filling curves. Without frames this is nearly as telling as frame
consistency is with them: `scripts/calibrate_priors.py` has the figures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.core.records import ungraphed
from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import component_sum, sqrt
from fmtorch.geometry.curves import curve_order_kernel, curve_orders
from fmtorch.jit.batches import for_each_pair, kernels_serve
from fmtorch.jit.kernel import Array, B1x1, F4x1, F4x2, inner, kernel
from fmtorch.pruning import calibration as calibration_kernels
from fmtorch.pruning.calibration import Calibration
from fmtorch.pruning.frame_consistency import add_products, tiled
from fmtorch.pruning.neighbors import (
    ANGLES,
    CURVES,
    CURVES32,
    EDGES,
    EDGES32,
    FARTHEST,
    FARTHEST32,
    HALF_COSINE32,
    HALF_SECTOR,
    HALF_SINE32,
    IDENTITY,
    MAPS32,
    MIN_SQUARE,
    MIN_SQUARE32,
    MIN_VOTE,
    MIN_VOTE32,
    MIN_VOTES32,
    NOISE,
    NOISE32,
    ONE32,
    SCALES,
    SHARPNESS,
    SHARPNESS32,
    TURNS,
    TWO_SECTORS,
    TWO_TANGENT32,
    WINDOW,
    WORST_RATIO,
    WORST_RATIO32,
)

# `position_consistency` for one pair, compiled: the same orders and the same sums, in float32


@kernel
def position_agreement_kernel(x0: F4x2, x1: F4x2, quality: F4x1, mask: B1x1, out: F4x1) -> None:
    """`position_consistency.position_agreement` of x0, x1 (n, 2), mask (n,) -> out (n,).

    quality: (n,), empty where unknown.
    """
    n = len(mask)
    rows, match = np.empty((5, n), x0.dtype), np.empty(n, np.int64)
    m = 0
    for i in range(n):
        out[i] = 0
        rows[0, m], rows[1, m], rows[2, m], rows[3, m] = x0[i, 0], x0[i, 1], x1[i, 0], x1[i, 1]
        rows[4, m] = max(WORST_RATIO32 - quality[i], MIN_VOTE32) if len(quality) else x0.dtype.type(1)
        valid = mask[i] and not (len(quality) and math.isnan(quality[i]))
        for k in range(5):
            valid = valid and abs(rows[k, m]) < FARTHEST32
        match[m] = i
        m += valid
    if m == 0:
        return
    orders, along = np.empty((2 * len(CURVES32), m), np.int64), np.empty((5, m), x0.dtype)
    for o in range(len(orders)):
        image, curve = o // len(CURVES32), o % len(CURVES32)
        curve_order_kernel(
            rows[2 * image, :m], rows[2 * image + 1, :m], CURVES32[curve, 0], CURVES32[curve, 1], CURVES32[curve, 2],
            orders[o],
        )  # fmt: skip
    scales, turns = MAPS32.shape[:2]
    bins = scales * turns
    merit = np.ones(bins, np.int64)
    for image in range(2):
        _put_in_order(rows, orders[image * len(CURVES32)], along)
        _multiply_by_histogram(along, merit)
    best, best_merit = 0, np.int64(-1)
    for first in range(bins):  # of equals the identity wins, then what comes before it
        index = (IDENTITY - first) % bins
        if merit[index] > best_merit:
            best, best_merit = index, merit[index]
    agreement, votes, agree = np.zeros(m, x0.dtype), np.zeros(m, x0.dtype), np.empty(m, x0.dtype)
    for o in range(len(orders)):
        _put_in_order(rows, orders[o], along)
        total, all_votes = np.zeros(m, x0.dtype), np.zeros(m, x0.dtype)
        for k in range(1, min(WINDOW, m - 1) + 1):
            _positions_agree(along, k, MAPS32[best // turns, best % turns], agree)
            add_products(agree, along[4, k:], m - k, total, all_votes)
            add_products(agree, along[4], m - k, total[k:], all_votes[k:])
        for i in range(m):
            agreement[orders[o, i]] += total[i]
            votes[orders[o, i]] += all_votes[i]
    for i in range(m):
        out[match[i]] = agreement[i] / max(votes[i], MIN_VOTES32)


@inner
def _put_in_order(rows: Array, order: Array, along: Array) -> None:
    """Columns of rows (d, n) in the order (m,) -> along (d, m)."""
    for k in range(len(rows)):
        for i in range(len(order)):
            along[k, i] = rows[k, order[i]]


@inner
def _multiply_by_histogram(along: Array, merit: Array) -> None:
    """Multiplies merit (s t,) by the smoothed votes of consecutive matches for their scale and turn."""
    scales, turns = MAPS32.shape[:2]
    votes, wide = np.zeros((scales, turns), np.int64), np.zeros((scales, turns), np.int64)
    for i in range(1, along.shape[1]):
        dx, dy = along[0, i] - along[0, i - 1], along[1, i] - along[1, i - 1]
        ux, uy = along[2, i] - along[2, i - 1], along[3, i] - along[3, i - 1]
        length0, length1 = dx * dx + dy * dy, ux * ux + uy * uy
        if not (length0 > 0 and length1 > 0):
            continue
        squared, level = length1 / length0, -1
        for edge in EDGES32:
            level += squared > edge
        if 0 <= level < scales:
            votes[level, _turn_kernel(dx * ux + dy * uy, dx * uy - dy * ux)] += 1
    for s in range(scales):
        for t in range(turns):
            wide[s, t] = 2 * votes[s, t] + votes[s, t - 1] + votes[s, (t + 1) % turns]
    for s in range(scales):
        for t in range(turns):
            smooth = 2 * wide[s, t]
            smooth += wide[s + 1, t] if s + 1 < scales else 0
            smooth += wide[s - 1, t] if s > 0 else 0
            merit[s * turns + t] *= smooth


@inner
def _turn_kernel(x: Any, y: Any) -> int:
    """Which of 16 sectors the direction (x, y) is in, as in `position_consistency`."""
    cosine, sine, tangent = HALF_COSINE32, HALF_SINE32, TWO_TANGENT32
    x, y = cosine * x - sine * y, sine * x + cosine * y
    sector = 0
    if y < 0:
        x, y, sector = -x, -y, 8
    if x <= 0:
        x, y, sector = y, -x, sector + 4
    if y >= x:
        x, y, sector = x + y, y - x, sector + 2
    return sector + (1 if y >= tangent * x else 0)


@inner
def _positions_agree(along: Array, k: int, similarity: Array, agree: Array) -> None:
    """How well matches i and i + k agree -> agree[i]."""
    noise, sharpness, tiny = NOISE32, SHARPNESS32, MIN_SQUARE32
    a, b, scale = similarity[0], similarity[1], similarity[2]
    X0, Y0, X1, Y1 = along[0], along[1], along[2], along[3]
    for i in range(along.shape[1] - k):
        dx, dy, ux, uy = X0[i + k] - X0[i], Y0[i + k] - Y0[i], X1[i + k] - X1[i], Y1[i + k] - Y1[i]
        p, q = a * dx - b * dy - ux, b * dx + a * dy - uy
        length = scale * math.sqrt(dx * dx + dy * dy + tiny) + math.sqrt(ux * ux + uy * uy + tiny) + noise
        t = ONE32 + (p * p + q * q) / (length * length) * sharpness
        t = t * t
        t = t * t
        t = t * t
        agree[i] = ONE32 / t


_BINS = len(SCALES) * TURNS


class Similarity(NamedTuple):
    """The map of small vectors ``(a x - b y, b x + a y)`` and its scale, of each pair, (B, 1)."""

    a: Tensor
    b: Tensor
    scale: Tensor


def position_agreement(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    quality: Float[Tensor, "b n"] | None,
    mask: Bool[Tensor, "b n"],
) -> Float[Tensor, "b n"]:
    """The share of its neighbours' votes that agree with each match, in [0, 1]; zero where masked.

    For neighbours with differences dx0, dx1 and the common similarity S of the pair, of scale s,
    ``e = |S dx0 - dx1| / (s |dx0| + |dx1| + NOISE)``; the agreement is the mean of ``(1 + (e / TOLERANCE)^2 / 8)^-8``
    over the neighbours in both images, weighted by votes (`frame_agreement` has the same constants and votes). On a CPU
    and without gradients it is computed in float32, by a kernel.
    """
    if kernels_serve(x0, x1, quality):
        out = torch.empty(mask.shape, dtype=torch.float32)
        return for_each_pair(position_agreement_kernel, (x0, x1, quality, mask), out=out).to(x0.dtype)
    vote = torch.ones_like(x0[..., 0]) if quality is None else (WORST_RATIO - quality).clamp_min(MIN_VOTE)
    rows = torch.stack([*x0.unbind(-1), *x1.unbind(-1), vote])
    mask = mask & (rows.abs() < FARTHEST).all(0)
    rows = torch.where(mask, rows, 0)
    return tiled(_agreement, rows, mask)


def _agreement(rows: Float[Tensor, "5 b n"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b n"]:
    """The agreement of matches x0, y0, x1, y1, vote along all curves in both images at once."""
    orders = curve_orders(rows[0:2].detach(), rows[2:4].detach(), mask, CURVES)
    orders = orders[..., : max(int(mask.sum(1).max()), 1)]  # masked slots stand last
    along = rows[:, None].expand(-1, len(orders), -1, -1).gather(3, orders.expand(len(rows), -1, -1, -1))
    S = common_similarity(along[:, 0].detach(), along[:, len(CURVES)].detach(), mask.sum(1))
    S = Similarity(*(value.repeat(len(orders), 1) for value in S))
    sums = torch.stack(_along_curve(along.flatten(1, 2), S)).reshape(2, *orders.shape)
    in_slots = sums.new_zeros(*sums.shape[:3], mask.shape[1]).scatter(3, orders.expand(2, -1, -1, -1), sums)
    agreement, votes = component_sum(in_slots, 1)
    return torch.where(mask, agreement / votes.clamp_min(torch.finfo(votes.dtype).tiny), 0)


def common_similarity(
    along0: Float[Tensor, "5 b n"], along1: Float[Tensor, "5 b n"], count: Int[Tensor, " b"]
) -> Similarity:
    """The turn and scale that most neighbours in either image have in common, out of TURNS x len(SCALES).

    along0, along1: (x0, y0, x1, y1, ...) of each pair's matches in their order along a curve of image 0 and of image 1,
    the first `count` of them. Every two consecutive matches vote for the turn and scale between them. Right matches
    vote alike in both orders. Wrong ones vote for large scales in the order of image 0, where they are near each other
    in image 0 alone, and for small ones in the other: the product of the two (smoothed) histograms is low there.
    """
    merit = _histogram(along0, count) * _histogram(along1, count)
    index = torch.arange(_BINS, device=merit.device)
    first = (IDENTITY - index).remainder(_BINS)  # of equals the identity wins
    best = (merit * _BINS + (_BINS - 1 - first)).argmax(1, keepdim=True)
    scale = along0.new_tensor(SCALES)[best // TURNS]
    cosine, sine = (along0.new_tensor([f(angle) for angle in ANGLES])[best % TURNS] for f in (math.cos, math.sin))
    return Similarity(scale * cosine, scale * sine, scale)


def _histogram(along: Float[Tensor, "5 b n"], count: Int[Tensor, " b"]) -> Int[Tensor, "b bins"]:
    """Votes for each scale and turn, those of adjoining bins counted in part (1, 2, 1)."""
    dx, dy, ux, uy = along[:4, :, 1:] - along[:4, :, :-1]
    length0, length1 = dx.square() + dy.square(), ux.square() + uy.square()
    level = torch.bucketize(length1 / length0, along.new_tensor(EDGES)) - 1
    valid = torch.arange(1, along.shape[2], device=along.device) < count[:, None]
    valid = valid & (length0 > 0) & (length1 > 0) & (level >= 0) & (level < len(SCALES))
    place = torch.where(valid, level * TURNS + _turn(dx * ux + dy * uy, dx * uy - dy * ux), _BINS)
    votes = torch.zeros(len(count), _BINS + 1, dtype=torch.int64, device=along.device)
    votes = votes.scatter_add(1, place, torch.ones_like(place))[:, :-1].reshape(-1, len(SCALES), TURNS)
    votes = 2 * votes + votes.roll(1, 2) + votes.roll(-1, 2)
    padded = torch.nn.functional.pad(votes, (0, 0, 1, 1))
    return (2 * votes + padded[:, 2:] + padded[:, :-2]).flatten(1)


def _turn(x: Tensor, y: Tensor) -> Int[Tensor, "b n"]:
    """Which of 16 sectors, centred on multiples of 22.5 degrees, the direction (x, y) is in; by comparisons alone."""
    cosine, sine = math.cos(HALF_SECTOR), math.sin(HALF_SECTOR)
    x, y = cosine * x - sine * y, sine * x + cosine * y
    half = y < 0
    x, y = torch.where(half, -x, x), torch.where(half, -y, y)
    quarter = x <= 0
    x, y = torch.where(quarter, y, x), torch.where(quarter, -x, y)
    eighth = y >= x
    x, y = torch.where(eighth, x + y, x), torch.where(eighth, y - x, y)
    sixteenth = y >= math.tan(TWO_SECTORS) * x
    return 8 * half.long() + 4 * quarter.long() + 2 * eighth.long() + sixteenth.long()


def _along_curve(rows: Float[Tensor, "5 b n"], S: Similarity) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n"]]:
    """Sums of agreeing votes and of all votes over the neighbours of each match along the curve.

    The agreement of two matches is the same either way, so each two are looked at once.
    """
    n = rows.shape[2]
    reach = min(WINDOW, max(n - 1, 0))
    padded = torch.nn.functional.pad(rows, (0, reach))
    total, votes = torch.zeros_like(rows[4]), torch.zeros_like(rows[4])
    if reach == 0:
        return total, votes
    later = torch.stack([padded[..., k : k + n] for k in range(1, reach + 1)], 1)  # (5, reach, b, n)
    dx, dy, ux, uy = later[:4] - rows[:4, None]
    error = (S.a * dx - S.b * dy - ux).square() + (S.b * dx + S.a * dy - uy).square()
    length = (
        S.scale * sqrt(dx.square() + dy.square() + MIN_SQUARE) + sqrt(ux.square() + uy.square() + MIN_SQUARE) + NOISE
    )
    agree = (1 + error / length.square() * SHARPNESS).square().square().square().reciprocal()
    # Added one by one: the order of a sum must not depend on the batch.
    forward, backward = agree * later[4], agree * rows[4]
    for k in range(1, reach + 1):
        shift = (k, 0)
        total = total + forward[k - 1] + torch.nn.functional.pad(backward[k - 1, :, : n - k], shift)
        votes = votes + later[4, k - 1] + torch.nn.functional.pad(rows[4, :, : n - k], shift)
    return total, votes


class PositionConsistency:
    """Supplies ``prior``: P(inlier) from the agreement of neighbours' motion and, where known, the ratio.

    Needs no frames, no sizes and no quality. Linear memory: about 600 bytes a match.
    kernels: worth compiling together with those of an estimator.
    """

    kernels: ClassVar = (position_agreement_kernel, calibration_kernels.calibrated)

    def __init__(self, *, calibration: Mapping[str, Mapping[str, float]]) -> None:
        self.calibration = Calibration(**calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches with a prior."""
        return ungraphed(c, lambda: self.calibration(c, self.evidence(c)))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from."""
        return position_agreement(c.x0, c.x1, c.quality, c.mask)
