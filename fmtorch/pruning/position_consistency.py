"""P(inlier) from points alone: does each match move as its neighbours do?

The pair's common turn and change of scale are found first, so that the images may be rotated and zoomed; then each
match is compared with its neighbours along space-filling curves. Without frames this is nearly as telling as frame
consistency is with them: `scripts/calibrate_priors.py` has the figures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.compiling.batches import for_each_pair, kernels_serve
from fmtorch.core.records import ungraphed
from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import component_sum, sqrt
from fmtorch.geometry.curves import curve_orders
from fmtorch.pruning import calibration_kernels
from fmtorch.pruning import position_consistency_kernels as compiled
from fmtorch.pruning.agreement import (
    ANGLES,
    CURVES,
    EDGES,
    FARTHEST,
    HALF_SECTOR,
    IDENTITY,
    MIN_SQUARE,
    MIN_VOTE,
    NOISE,
    SCALES,
    SHARPNESS,
    TURNS,
    TWO_SECTORS,
    WINDOW,
    WORST_RATIO,
)
from fmtorch.pruning.calibration import Calibration
from fmtorch.pruning.frame_consistency import tiled

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
        return for_each_pair(compiled.position_agreement, (x0, x1, quality, mask), out=out).to(x0.dtype)
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

    kernels: ClassVar = (compiled.position_agreement, calibration_kernels.calibrated)

    def __init__(self, *, calibration: Mapping[str, Mapping[str, float]]) -> None:
        self.calibration = Calibration(**calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches with a prior."""
        return ungraphed(c, lambda: self.calibration(c, self.evidence(c)))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from."""
        return position_agreement(c.x0, c.x1, c.quality, c.mask)
