"""P(inlier) from points alone: does each match move as its neighbours do?

The pair's common turn and change of scale are found first, so that the images may be rotated and zoomed; then each
match is compared with its neighbours along space-filling curves. Without frames this is nearly as telling as frame
consistency is with them: `scripts/calibrate_priors.py` has the figures.
"""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.records import ungraphed
from fmtorch.core.types import Correspondences
from fmtorch.geometry.optimum import gradient_wanted
from fmtorch.jit.batches import for_each_pair
from fmtorch.jit.kernel import Array, B1x1, F4x1, F4x2, inner, kernel
from fmtorch.pruning.calibration import Calibration
from fmtorch.pruning.neighbors import (
    CURVES32,
    FARTHEST32,
    MIN_SQUARE32,
    MIN_VOTE32,
    MIN_VOTES32,
    NOISE32,
    ONE32,
    SHARPNESS32,
    WINDOW,
    WORST_RATIO32,
    add_products,
    curve_orders,
    put_in_order,
    votes_of,
    with_gradient,
)

# `position_consistency` for one pair, compiled; float32


TURNS = 16  # hypotheses of the turn that a pair's neighbours have in common
SCALES = tuple(2.0 ** (k / 2) for k in range(-4, 5))  # hypotheses of their change of scale
IDENTITY = SCALES.index(1.0) * TURNS  # the hypothesis scale * TURNS + turn that changes nothing
EDGES32 = np.array([2.0 ** (k / 2) for k in range(-9, 11, 2)], np.float32)  # of squared scales, halfway between these
_ANGLES = [2 * math.pi * k / TURNS for k in range(TURNS)]
_SCALES32 = np.array(SCALES, np.float32)[:, None]
_COSINES32, _SINES32 = (np.array([f(angle) for angle in _ANGLES], np.float32) for f in (math.cos, math.sin))
MAPS32 = np.stack(np.broadcast_arrays(_SCALES32 * _COSINES32, _SCALES32 * _SINES32, _SCALES32), -1).copy()
"""(scales, turns, 3), of each its cosine and sine, times the scale, and the scale."""
HALF_COSINE32, HALF_SINE32 = np.float32(math.cos(math.pi / TURNS)), np.float32(math.sin(math.pi / TURNS))
TWO_TANGENT32 = np.float32(math.tan(math.pi / 8))


@kernel
def position_agreement_kernel(x0: F4x2, x1: F4x2, ratio: F4x1, mask: B1x1, out: F4x1) -> None:
    """`position_consistency.position_agreement` of x0, x1 (n, 2), mask (n,), and its a, b and s -> out (n + 3,).

    ratio: (n,), empty where unknown.
    """
    n, m = len(mask), 0
    out[:] = 0
    rows, match = np.empty((5, n), x0.dtype), np.empty(n, np.int64)
    for i in range(n):
        rows[0, m], rows[1, m], rows[2, m], rows[3, m] = x0[i, 0], x0[i, 1], x1[i, 0], x1[i, 1]
        rows[4, m] = max(WORST_RATIO32 - ratio[i], MIN_VOTE32) if len(ratio) else x0.dtype.type(1)
        valid = mask[i] and not (len(ratio) and math.isnan(ratio[i]))
        for k in range(5):
            valid = valid and abs(rows[k, m]) < FARTHEST32
        match[m] = i
        m += valid
    if m == 0:
        return
    orders, along = np.empty((2 * len(CURVES32), m), np.int64), np.empty((5, m), x0.dtype)
    curve_orders(rows, orders)
    similarity = _similarity(rows, orders, along)
    agreement, votes, agree = np.zeros(m, x0.dtype), np.zeros(m, x0.dtype), np.empty(m, x0.dtype)
    for order in orders:
        put_in_order(rows, order, along)
        total, all_votes = np.zeros(m, x0.dtype), np.zeros(m, x0.dtype)
        for k in range(1, min(WINDOW, m - 1) + 1):
            _positions_agree(along, k, similarity, agree)
            add_products(agree, along[4, k:], m - k, total, all_votes)
            add_products(agree, along[4], m - k, total[k:], all_votes[k:])
        for i in range(m):
            agreement[order[i]] += total[i]
            votes[order[i]] += all_votes[i]
    for i in range(m):
        out[match[i]] = agreement[i] / max(votes[i], MIN_VOTES32)
    for k in range(3):
        out[n + k] = similarity[k]


@inner
def _similarity(rows: Array, orders: Array, along: Array) -> Array:
    """The map of small vectors (a x - b y, b x + a y) that most neighbours in either image have in common: a, b, s.

    Every two consecutive matches along a curve vote for the turn and scale between them. Right matches vote alike in
    both images' orders. Wrong ones vote for large scales in the order of image 0, where they are near each other in
    image 0 alone, and for small ones in the other: the product of the two (smoothed) histograms is low there.
    """
    scales, turns = MAPS32.shape[:2]
    bins = scales * turns
    merit = np.ones(bins, np.int64)
    for image in range(2):
        put_in_order(rows, orders[image * len(CURVES32)], along)
        _multiply_by_histogram(along, merit)
    best, best_merit = 0, np.int64(-1)
    for first in range(bins):  # of equals the identity wins, then what comes before it
        index = (IDENTITY - first) % bins
        if merit[index] > best_merit:
            best, best_merit = index, merit[index]
    similarity: Array = MAPS32[best // turns, best % turns]
    return similarity


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
            votes[level, _turn(dx * ux + dy * uy, dx * uy - dy * ux)] += 1
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
def _turn(x: Any, y: Any) -> int:
    """Which of 16 sectors, centred on multiples of 22.5 degrees, the direction (x, y) is in; by comparisons alone."""
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


def position_agreement(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    ratio: Float[Tensor, "b n"] | None,
    mask: Bool[Tensor, "b n"],
) -> Float[Tensor, "b n"]:
    """The share of its neighbours' votes that agree with each match, in [0, 1]; zero where masked.

    For neighbours with differences dx0, dx1 and the common similarity S of the pair, of scale s,
    ``e = |S dx0 - dx1| / (s |dx0| + |dx1| + NOISE)``; the agreement is the mean of ``(1 + (e / TOLERANCE)^2 / 8)^-8``
    over the neighbours in both images, weighted by votes (`frame_agreement` has the same constants and votes). Computed
    in float32, on the CPU; differentiable in points and ratio, S being a constant.
    """
    out = torch.empty(len(mask), mask.shape[1] + 3, dtype=torch.float32)
    out = for_each_pair(position_agreement_kernel, (x0, x1, ratio, mask), out=out).to(x0.dtype)
    agreement, (a, b, _) = out[:, :-3], out[:, -3:].unbind(1)
    if not gradient_wanted(x0, x1, ratio):
        return agreement
    S = torch.stack([a, -b, b, a], -1).reshape(-1, 1, 2, 2).expand(*mask.shape, 2, 2)
    return with_gradient(agreement, x0, x1, S, votes_of(ratio, x0[..., 0]), mask)


class PositionConsistency:
    """Supplies ``prior``: P(inlier) from the agreement of neighbours' motion and, where known, the ratio.

    Needs no frames, no sizes and no ratio. Linear memory: about 600 bytes a match.
    kernels: worth compiling together with those of an estimator.
    """

    kernels: ClassVar = (position_agreement_kernel,)

    def __init__(self, *, calibration: Mapping[str, Mapping[str, float]]) -> None:
        self.calibration = Calibration(**calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches with a prior."""
        return ungraphed(c, lambda: self.calibration(c, self.evidence(c)))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from."""
        return position_agreement(c.x0, c.x1, c.ambiguity, c.mask)
