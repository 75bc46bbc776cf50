"""`frame_consistency` and `position_consistency` for one pair, compiled: the same orders and the same sums.

Arrays of a pair are in one floating type, float32 or float64. `numbers` are constants in that type:
shift, cosine and sine of each curve, then what each kernel names.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.geometry.curves_kernels import curve_order
from fmtorch.kernels import inner, kernel

Array = NDArray[Any]
WINDOW = 8  # as in `frame_consistency`


@kernel("f4[:, ::1], f4[:, ::1], f4[:, :, ::1], f4[:, :, ::1], f4[::1], b1[::1], f4[:, ::1], f4[::1], f4[::1]")
def frame_agreement(
    x0: Array, x1: Array, lafs0: Array, lafs1: Array, quality: Array, mask: Array, curves: Array, numbers: Array,
    out: Array,
) -> None:  # fmt: skip
    """`frame_consistency.frame_agreement` of x0, x1 (n, 2), lafs0, lafs1 (n, 2, 3), mask (n,) -> out (n,).

    quality: (n,), empty where unknown. curves: (c, 3), shift of the grid, cosine and sine of the rotation.
    numbers: of votes the worst ratio and the least, noise in pixels, TOLERANCE^-2 / 8, 1e-12, the least divisor.
    """
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
        rows[9, m] = max(numbers[0] - quality[i], numbers[1]) if len(quality) else x0.dtype.type(1)
        sound = mask[i] and not (len(quality) and math.isnan(quality[i]))
        for k in range(10):
            sound = sound and math.isfinite(rows[k, m])
        match[m] = i
        m += sound
    order, along = np.empty(m, np.int64), np.empty((10, m), x0.dtype)
    agreement, votes = np.zeros(m, x0.dtype), np.zeros(m, x0.dtype)
    ahead, behind = np.empty((WINDOW, m), x0.dtype), np.empty((WINDOW, m), x0.dtype)
    for image in range(2):
        for curve in range(len(curves)):
            curve_order(
                rows[2 * image, :m],
                rows[2 * image + 1, :m],
                curves[curve, 0],
                curves[curve, 1],
                curves[curve, 2],
                order,
            )
            for k in range(10):
                for i in range(m):
                    along[k, i] = rows[k, order[i]]
            for k in range(1, WINDOW + 1):
                _frames_agree(along, k, numbers, ahead[k - 1], behind[k - 1])
            _add_votes(along[9], ahead, behind, order, agreement, votes)
    for i in range(m):
        out[match[i]] = agreement[i] / max(votes[i], numbers[5])


@inner
def _frames_agree(along: Array, k: int, numbers: Array, ahead: Array, behind: Array) -> None:
    """For matches i and j = i + k: how well j agrees with i -> ahead[i], i with j -> behind[i]."""
    noise, sharpness, tiny, one = numbers[2], numbers[3], numbers[4], along.dtype.type(1)
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
        length = length0 * S[i] + length1 + noise
        t = one + error / (length * length) * sharpness
        t = t * t
        t = t * t
        t = t * t
        ahead[i] = one / t
        length = length0 * S[j] + length1 + noise
        t = one + error / (length * length) * sharpness
        t = t * t
        t = t * t
        t = t * t
        behind[i] = one / t


@inner
def _add_votes(vote: Array, ahead: Array, behind: Array, order: Array, agreement: Array, votes: Array) -> None:
    """Adds the votes of the neighbours along a curve, from the farthest before to the farthest after."""
    m = len(vote)
    total, all_votes = np.zeros(m, vote.dtype), np.zeros(m, vote.dtype)
    for k in range(min(WINDOW, m - 1), 0, -1):
        _add_products(behind[k - 1], vote, m - k, total[k:], all_votes[k:])
    for k in range(1, min(WINDOW, m - 1) + 1):
        _add_products(ahead[k - 1], vote[k:], m - k, total, all_votes)
    for i in range(m):
        agreement[order[i]] += total[i]
        votes[order[i]] += all_votes[i]


@inner
def _add_products(agree: Array, vote: Array, count: int, total: Array, votes: Array) -> None:
    """Adds the first agreeing votes to the totals, and the votes."""
    for i in range(count):
        total[i] += agree[i] * vote[i]
    for i in range(count):
        votes[i] += vote[i]


@kernel("f4[::1], f4[::1], b1[::1], f4, f4, f4, f4[::1]")
def frame_prior(
    agreement: Array, quality: Array, mask: Array, odds: Any, floor: Any, slope: Any, out: Array
) -> None:  # fmt: skip
    """P(inlier) of `FrameConsistency` from agreement and ratio (n,) -> out (n,); zero where masked or not finite."""
    one = agreement.dtype.type(1)
    for i in range(len(mask)):
        w, divisor = agreement[i] + floor, one + slope * quality[i]
        o = odds * w * w * w / (divisor * divisor)
        out[i] = o / (one + o) if mask[i] and math.isfinite(quality[i]) else one - one


@kernel("f4[:, ::1], f4[:, ::1], f4[::1], b1[::1], f4[:, ::1], f4[::1], f4[::1], f4[:, :, ::1], f4[::1]")
def position_agreement(
    x0: Array, x1: Array, quality: Array, mask: Array, curves: Array, numbers: Array, edges: Array, maps: Array,
    out: Array,
) -> None:  # fmt: skip
    """`position_consistency.position_agreement` of x0, x1 (n, 2), mask (n,) -> out (n,).

    quality: (n,), empty where unknown. curves: (c, 3), shift of the grid, cosine and sine of the rotation.
    numbers: of votes the worst ratio and the least, noise in pixels, TOLERANCE^-2 / 8, 1e-12, the least divisor, the
    farthest coordinate, cosine and sine of half a sector, tangent of two, and the index of the identity in maps.
    edges: (s + 1,), of squared scales. maps: (s, t, 3), of each scale and turn its cosine and sine, scaled, and scale.
    """
    n = len(mask)
    rows, match = np.empty((5, n), x0.dtype), np.empty(n, np.int64)
    m = 0
    for i in range(n):
        out[i] = 0
        rows[0, m], rows[1, m], rows[2, m], rows[3, m] = x0[i, 0], x0[i, 1], x1[i, 0], x1[i, 1]
        rows[4, m] = max(numbers[0] - quality[i], numbers[1]) if len(quality) else x0.dtype.type(1)
        sound = mask[i] and not (len(quality) and math.isnan(quality[i]))
        for k in range(5):
            sound = sound and abs(rows[k, m]) < numbers[6]
        match[m] = i
        m += sound
    if m == 0:
        return
    orders, along = np.empty((2 * len(curves), m), np.int64), np.empty((5, m), x0.dtype)
    for o in range(len(orders)):
        image, curve = o // len(curves), o % len(curves)
        curve_order(
            rows[2 * image, :m], rows[2 * image + 1, :m], curves[curve, 0], curves[curve, 1], curves[curve, 2],
            orders[o],
        )  # fmt: skip
    bins = maps.shape[0] * maps.shape[1]
    merit = np.ones(bins, np.int64)
    for image in range(2):
        _put_in_order(rows, orders[image * len(curves)], along)
        _multiply_by_histogram(along, edges, numbers, maps.shape[1], merit)
    identity, best, best_merit = np.int64(numbers[10]), 0, np.int64(-1)
    for first in range(bins):  # of equals the identity wins, then what comes before it
        index = (identity - first) % bins
        if merit[index] > best_merit:
            best, best_merit = index, merit[index]
    agreement, votes, agree = np.zeros(m, x0.dtype), np.zeros(m, x0.dtype), np.empty(m, x0.dtype)
    for o in range(len(orders)):
        _put_in_order(rows, orders[o], along)
        total, all_votes = np.zeros(m, x0.dtype), np.zeros(m, x0.dtype)
        for k in range(1, min(WINDOW, m - 1) + 1):
            _positions_agree(along, k, maps[best // maps.shape[1], best % maps.shape[1]], numbers, agree)
            _add_products(agree, along[4, k:], m - k, total, all_votes)
            _add_products(agree, along[4], m - k, total[k:], all_votes[k:])
        for i in range(m):
            agreement[orders[o, i]] += total[i]
            votes[orders[o, i]] += all_votes[i]
    for i in range(m):
        out[match[i]] = agreement[i] / max(votes[i], numbers[5])


@inner
def _put_in_order(rows: Array, order: Array, along: Array) -> None:
    """Columns of rows (d, n) in the order (m,) -> along (d, m)."""
    for k in range(len(rows)):
        for i in range(len(order)):
            along[k, i] = rows[k, order[i]]


@inner
def _multiply_by_histogram(along: Array, edges: Array, numbers: Array, turns: int, merit: Array) -> None:
    """Multiplies merit (s t,) by the smoothed votes of consecutive matches for their scale and turn."""
    scales = len(edges) - 1
    votes, wide = np.zeros((scales, turns), np.int64), np.zeros((scales, turns), np.int64)
    for i in range(1, along.shape[1]):
        dx, dy = along[0, i] - along[0, i - 1], along[1, i] - along[1, i - 1]
        ux, uy = along[2, i] - along[2, i - 1], along[3, i] - along[3, i - 1]
        length0, length1 = dx * dx + dy * dy, ux * ux + uy * uy
        if not (length0 > 0 and length1 > 0):
            continue
        squared, level = length1 / length0, -1
        for edge in edges:
            level += squared > edge
        if 0 <= level < scales:
            votes[level, _turn(dx * ux + dy * uy, dx * uy - dy * ux, numbers)] += 1
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
def _turn(x: Any, y: Any, numbers: Array) -> int:
    """Which of 16 sectors the direction (x, y) is in, as in `position_consistency`."""
    cosine, sine, tangent = numbers[7], numbers[8], numbers[9]
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
def _positions_agree(along: Array, k: int, similarity: Array, numbers: Array, agree: Array) -> None:
    """How well matches i and i + k agree -> agree[i]."""
    noise, sharpness, tiny, one = numbers[2], numbers[3], numbers[4], along.dtype.type(1)
    a, b, scale = similarity[0], similarity[1], similarity[2]
    X0, Y0, X1, Y1 = along[0], along[1], along[2], along[3]
    for i in range(along.shape[1] - k):
        dx, dy, ux, uy = X0[i + k] - X0[i], Y0[i + k] - Y0[i], X1[i + k] - X1[i], Y1[i + k] - Y1[i]
        p, q = a * dx - b * dy - ux, b * dx + a * dy - uy
        length = scale * math.sqrt(dx * dx + dy * dy + tiny) + math.sqrt(ux * ux + uy * uy + tiny) + noise
        t = one + (p * p + q * q) / (length * length) * sharpness
        t = t * t
        t = t * t
        t = t * t
        agree[i] = one / t
