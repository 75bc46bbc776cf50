"""P(inlier) from the agreement of neighbouring matches: by their local affine frames, or by their motion alone.

A match with frames carries a scale and a rotation (or a full affine shape) in both images, so it maps the small vector
to a neighbour in image 0 to one in image 1. Where matches are right, neighbours agree with each other's maps. Without
frames the pair's common turn and change of scale are found first, so that the images may be rotated and zoomed; then
each match is compared with its neighbours. That is nearly as telling: `scripts/calibrate_priors.py` has the figures.

Neighbours are along space-filling curves: linear memory, an eighth of the time of exact ones, the same ROC area."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import component_sum, gradient_wanted, sqrt
from fmtorch.jit.kernel import Array, B1x1, F4x1, F4x2, F4x3, I8x2, for_each_pair, inner, kernel
from fmtorch.pruning.calibration import Calibration, calibrated
from fmtorch.pruning.neighbors import CURVES, CURVES32, curve_orders, put_in_order

WINDOW = 8  # neighbours before and after each match along each curve
TOLERANCE = 0.25  # relative prediction error at which agreement falls to about 1/e
SHARPNESS = TOLERANCE**-2 / 8
NOISE = 4.0  # px, keeps close neighbours from being judged by their localisation noise
WORST_RATIO, MIN_VOTE = 0.85, 0.02  # a neighbour votes with WORST_RATIO - ratio, at least MIN_VOTE
MIN_SQUARE, MIN_VOTES = 1e-12, float(np.finfo(np.float32).tiny)  # keep a root's gradient and a quotient finite
Points = Float[Tensor, "b n 2"]
Frames = Float[Tensor, "b n 2 3"]
Maps = Float[Tensor, "b n 2 2"]
PerMatch = Float[Tensor, "b n"]
FARTHEST = 1e15  # px; a match beyond is none: its squares could overflow

SHARPNESS32, NOISE32, FARTHEST32 = np.float32(SHARPNESS), np.float32(NOISE), np.float32(FARTHEST)
WORST_RATIO32, MIN_VOTE32 = np.float32(WORST_RATIO), np.float32(MIN_VOTE)
MIN_SQUARE32, MIN_VOTES32, ONE32 = np.float32(MIN_SQUARE), np.float32(MIN_VOTES), np.float32(1)


class FramedMatches(NamedTuple):
    """Matches of a pair: points x0, x1 (n, 2), frames lafs0, lafs1 (n, 2, 3), px; mask, ratio (n,), empty: unknown."""

    x0: F4x2
    x1: F4x2
    lafs0: F4x3
    lafs1: F4x3
    ratio: F4x1
    mask: B1x1


@kernel
def frame_agreement_kernel(matches: FramedMatches, out: F4x1) -> None:
    """`frame_agreement` of n matches -> out (n,)."""
    x0, x1, lafs0, lafs1, ratio, mask = matches
    n, zero = len(mask), x0.dtype.type(0)
    rows, match = np.empty((10, n), x0.dtype), np.empty(n, np.int64)
    m = 0
    for i in range(n):
        out[i] = zero
        a, b, c, d = lafs0[i, 0, 0], lafs0[i, 0, 1], lafs0[i, 1, 0], lafs0[i, 1, 1]
        determinant = a * d - b * c
        rows[0, m], rows[1, m], rows[2, m], rows[3, m] = x0[i, 0], x0[i, 1], x1[i, 0], x1[i, 1]
        rows[4, m] = (lafs1[i, 0, 0] * d + lafs1[i, 0, 1] * -c) / determinant
        rows[5, m] = (lafs1[i, 0, 0] * -b + lafs1[i, 0, 1] * a) / determinant
        rows[6, m] = (lafs1[i, 1, 0] * d + lafs1[i, 1, 1] * -c) / determinant
        rows[7, m] = (lafs1[i, 1, 0] * -b + lafs1[i, 1, 1] * a) / determinant
        rows[8, m] = math.sqrt(abs(rows[4, m] * rows[7, m] - rows[5, m] * rows[6, m]))
        rows[9, m] = max(WORST_RATIO32 - ratio[i], MIN_VOTE32) if len(ratio) else x0.dtype.type(1)
        valid = mask[i] and not (len(ratio) and math.isnan(ratio[i]))
        for k in range(10):
            valid = valid and math.isfinite(rows[k, m])
        match[m] = i
        m += valid
    orders, along = np.empty((2 * len(CURVES32), m), np.int64), np.empty((10, m), x0.dtype)
    curve_orders(rows, orders)
    agreement, votes = np.zeros(m, x0.dtype), np.zeros(m, x0.dtype)
    ahead, behind = np.empty((WINDOW, m), x0.dtype), np.empty((WINDOW, m), x0.dtype)
    for order in orders:
        put_in_order(rows, order, along)
        for k in range(1, WINDOW + 1):
            _frames_agree(along, k, ahead[k - 1], behind[k - 1])
        _add_votes(along[9], ahead, behind, order, agreement, votes)
    for i in range(m):
        out[match[i]] = agreement[i] / max(votes[i], MIN_VOTES32)


@inner
def _vote_of(error: Any, length: Any) -> Any:
    """``(1 + (e / TOLERANCE)^2 / 8)^-8`` of a squared error and what it is relative to."""
    t = ONE32 + error / (length * length) * SHARPNESS32
    t = t * t
    t = t * t
    return ONE32 / (t * t)


@inner
def _frames_agree(along: Array, k: int, ahead: Array, behind: Array) -> None:
    """For matches i and j = i + k: how well j agrees with i -> ahead[i], i with j -> behind[i]."""
    noise, tiny = NOISE32, MIN_SQUARE32
    X0, Y0, X1, Y1, A, B, C, D, S = (
        along[0], along[1], along[2], along[3], along[4], along[5], along[6], along[7], along[8],
    )  # fmt: skip
    for i in range(along.shape[1] - k):
        j = i + k
        dx, dy, ux, uy = X0[j] - X0[i], Y0[j] - Y0[i], X1[j] - X1[i], Y1[j] - Y1[i]
        p, q = A[i] * dx + B[i] * dy - ux, C[i] * dx + D[i] * dy - uy
        r, s = A[j] * dx + B[j] * dy - ux, C[j] * dx + D[j] * dy - uy
        own, other = p * p + q * q, r * r + s * s
        error = own if own > other else other
        length0, length1 = math.sqrt(dx * dx + dy * dy + tiny), math.sqrt(ux * ux + uy * uy + tiny)
        ahead[i] = _vote_of(error, length0 * S[i] + length1 + noise)
        behind[i] = _vote_of(error, length0 * S[j] + length1 + noise)


@inner
def _add_votes(vote: Array, ahead: Array, behind: Array, order: Array, agreement: Array, votes: Array) -> None:
    """Adds the votes of the neighbours along a curve, from the farthest before to the farthest after."""
    m = len(vote)
    total, all_votes = np.zeros(m, vote.dtype), np.zeros(m, vote.dtype)
    for k in range(min(WINDOW, m - 1), 0, -1):
        add_products(behind[k - 1], vote, m - k, total[k:], all_votes[k:])
    for k in range(1, min(WINDOW, m - 1) + 1):
        add_products(ahead[k - 1], vote[k:], m - k, total, all_votes)
    for i in range(m):
        agreement[order[i]] += total[i]
        votes[order[i]] += all_votes[i]


@kernel
def frame_prior_kernel(matches: FramedMatches, numbers: F4x1, out: F4x1) -> None:
    """P(inlier) of `FrameConsistency` of n matches -> out (n,). numbers: odds, floor, slope."""
    odds, floor, slope = numbers[0], numbers[1], numbers[2]
    frame_agreement_kernel(matches, out)
    for i in range(len(out)):
        w, divisor = out[i] + floor, ONE32 + slope * matches.ratio[i]
        o = odds * w * w * w / (divisor * divisor)
        out[i] = o / (ONE32 + o) if matches.mask[i] and math.isfinite(matches.ratio[i]) else ONE32 - ONE32


def frame_agreement(
    x0: Points, x1: Points, lafs0: Frames, lafs1: Frames, ratio: PerMatch | None, mask: Bool[Tensor, "b n"]
) -> PerMatch:
    """The share of its neighbours' votes that agree with each match, in [0, 1]; zero where masked.
    For neighbours i, j with frame maps S: ``e = max(|S_i dx0 - dx1|, |S_j dx0 - dx1|) / (s_i |dx0| + |dx1| + NOISE)``
    with s the scale change of S; the agreement is the mean of ``(1 + (e / TOLERANCE)^2 / 8)^-8`` over the neighbours in
    both images, weighted by votes. Computed in float32, on the CPU; differentiable in all but the mask."""
    tensors, out = (x0, x1, lafs0, lafs1, ratio, mask), torch.empty(mask.shape, dtype=torch.float32)
    agreement = for_each_pair(frame_agreement_kernel, tensors, out=out, group=FramedMatches).to(x0.dtype)
    if not gradient_wanted(x0, x1, lafs0, lafs1, ratio):
        return agreement
    maps, usable = usable_frame_maps(lafs0, lafs1, mask)
    return with_gradient(agreement, x0, x1, maps, votes_of(ratio, x0[..., 0]), usable)


def frame_map(lafs0: Frames, lafs1: Frames) -> Maps:
    """The linear map from frame 0 to frame 1, ``A1 A0^-1``."""
    (a, b), (c, d) = (row.unbind(-1) for row in lafs0[..., :2].unbind(-2))
    determinant = a * d - b * c
    inverse = torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2)
    product = (lafs1[..., :2][..., :, :, None] * inverse[..., None, :, :]).sum(-2)
    return product / determinant[..., None, None]


def usable_frame_maps(lafs0: Frames, lafs1: Frames, mask: Bool[Tensor, "b n"]) -> tuple[Maps, Bool[Tensor, "b n"]]:
    """`frame_map`, and of which matches: the identity where masked, and for frames not finite or without area."""
    for lafs in (lafs0, lafs1):
        (a, b), (c, d) = (row.unbind(-1) for row in lafs[..., :2].unbind(-2))
        mask = mask & torch.isfinite(lafs).flatten(2).all(2) & (a * d - b * c != 0)
    unit = torch.eye(2, 3, dtype=lafs0.dtype, device=lafs0.device)
    return frame_map(*(torch.where(mask[..., None, None], lafs, unit) for lafs in (lafs0, lafs1))), mask


class FrameConsistency:
    """Supplies ``prior``: P(inlier) from the agreement of local affine frames and the ratio.
    The odds are ``odds (w + floor)^3 / (1 + slope ratio)^2`` with the agreement w: arithmetic alone, and a better fit
    on the tuning scenes than a logistic model of ln(w) and the ratio. Where matches have no frames or no ratio the
    prior is left as it is. About 700 bytes a match. kernels: to compile with an estimator's."""

    kernels: ClassVar = (frame_prior_kernel, frame_agreement_kernel)

    def __init__(self, *, odds: float, floor: float, slope: float) -> None:
        self.odds, self.floor, self.slope = odds, floor, slope

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches with a prior; zero for one whose ratio is not finite."""
        ratio = c.ambiguity
        if c.lafs0 is None or c.lafs1 is None or ratio is None:
            return c
        matches = c.x0, c.x1, c.lafs0, c.lafs1, ratio, c.mask
        numbers = np.array((self.odds, self.floor, self.slope), np.float32)
        out = torch.empty(c.mask.shape, dtype=torch.float32)
        prior = for_each_pair(frame_prior_kernel, matches, numbers, out=out, group=FramedMatches)
        if gradient_wanted(*matches):
            w, known = frame_agreement(*matches), c.mask & torch.isfinite(ratio)
            ratio = torch.where(known, ratio, 1)
            log_odds = 3 * w / (w + self.floor).detach() - 2 * ratio * (self.slope / (1 + self.slope * ratio)).detach()
            prior = prior + prior * (1 - prior) * (log_odds - log_odds.detach())  # adds zeros
        return c.derived(prior=prior.to(c.x0.dtype))


# By motion alone

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
    """`position_agreement` of x0, x1 (n, 2), mask, ratio (n,), empty if unknown, and its a, b and s -> out (n + 3,)."""
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
    image 0 alone, and for small ones in the other: the product of the two (smoothed) histograms is low there."""
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
    return MAPS32[best // turns, best % turns]  # type: ignore[no-any-return]


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
    noise, tiny = NOISE32, MIN_SQUARE32
    a, b, scale = similarity[0], similarity[1], similarity[2]
    X0, Y0, X1, Y1 = along[0], along[1], along[2], along[3]
    for i in range(along.shape[1] - k):
        dx, dy, ux, uy = X0[i + k] - X0[i], Y0[i + k] - Y0[i], X1[i + k] - X1[i], Y1[i + k] - Y1[i]
        p, q = a * dx - b * dy - ux, b * dx + a * dy - uy
        length = scale * math.sqrt(dx * dx + dy * dy + tiny) + math.sqrt(ux * ux + uy * uy + tiny) + noise
        agree[i] = _vote_of(p * p + q * q, length)


def position_agreement(x0: Points, x1: Points, ratio: PerMatch | None, mask: Bool[Tensor, "b n"]) -> PerMatch:
    """The share of its neighbours' votes that agree with each match, in [0, 1]; zero where masked.
    For neighbours with differences dx0, dx1 and the common similarity S of the pair, of scale s, ``e = |S dx0 - dx1| /
    (s |dx0| + |dx1| + NOISE)``; the agreement is the mean of ``(1 + (e / TOLERANCE)^2 / 8)^-8`` over the neighbours in
    both images, weighted by votes (`frame_agreement` has the same constants and votes). Computed in float32, on the
    CPU; differentiable in points and ratio, S being a constant."""
    out = torch.empty(len(mask), mask.shape[1] + 3, dtype=torch.float32)
    out = for_each_pair(position_agreement_kernel, (x0, x1, ratio, mask), out=out).to(x0.dtype)
    agreement, (a, b, _) = out[:, :-3], out[:, -3:].unbind(1)
    if not gradient_wanted(x0, x1, ratio):
        return agreement
    S = torch.stack([a, -b, b, a], -1).reshape(-1, 1, 2, 2).expand(*mask.shape, 2, 2)
    return with_gradient(agreement, x0, x1, S, votes_of(ratio, x0[..., 0]), mask)


class PositionConsistency:
    """Supplies ``prior``: P(inlier) from the agreement of neighbours' motion and, where known, the ratio or score.
    Needs no frames, sizes or ratio. About 600 bytes a match. kernels: to compile with an estimator's."""

    kernels: ClassVar = (position_agreement_kernel, calibrated)

    def __init__(self, *, calibration: Mapping[str, Mapping[str, float]]) -> None:
        self.calibration = Calibration(**calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        return self.calibration(c, self.evidence(c))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from."""
        return position_agreement(c.x0, c.x1, c.ratio, c.mask)


@inner
def add_products(agree: Array, vote: Array, count: int, total: Array, votes: Array) -> None:
    """Adds so many agreeing votes to the totals, and the votes."""
    for i in range(count):
        total[i] += agree[i] * vote[i]
    for i in range(count):
        votes[i] += vote[i]


def votes_of(ratio: Float[Tensor, "b n"] | None, like: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
    """What the vote of each match counts."""
    return torch.ones_like(like) if ratio is None else (WORST_RATIO - ratio).clamp_min(MIN_VOTE)


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


def with_gradient(
    agreement: PerMatch, x0: Points, x1: Points, maps: Maps, vote: PerMatch, mask: Bool[Tensor, "b n"]
) -> PerMatch:
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
    agree = (1 + torch.maximum(own, other) / length.square() * SHARPNESS).square().square().square().reciprocal()
    votes = torch.stack([agree * near[9], near[9].expand_as(agree)])
    votes = component_sum(torch.cat([votes[..., :WINDOW, :], votes[..., WINDOW + 1 :, :]], -2), -2)  # others' alone
    in_slots = torch.zeros_like(votes).scatter(3, orders.expand(2, -1, -1, -1), votes)
    agreement, total = component_sum(in_slots, 1)
    return agreement / total.clamp_min(torch.finfo(total.dtype).tiny)  # type: ignore[no-any-return]
