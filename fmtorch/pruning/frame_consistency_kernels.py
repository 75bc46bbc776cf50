"""`frame_consistency` for one pair, compiled; float32."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, B1x1, F4x1, F4x2, F4x3
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.pruning.agreement import (
    CURVES32,
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
)


class FramedMatches(NamedTuple):
    """The matches of one pair: points x0, x1 (n, 2), frames lafs0, lafs1 (n, 2, 3), pixels; which are real, mask (n,).

    quality: (n,), empty where unknown.
    """

    x0: F4x2
    x1: F4x2
    lafs0: F4x3
    lafs1: F4x3
    quality: F4x1
    mask: B1x1


@kernel
def frame_agreement(matches: FramedMatches, out: F4x1) -> None:
    """`frame_consistency.frame_agreement` of n matches -> out (n,)."""
    x0, x1, lafs0, lafs1, quality, mask = matches
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
        rows[9, m] = max(WORST_RATIO32 - quality[i], MIN_VOTE32) if len(quality) else x0.dtype.type(1)
        valid = mask[i] and not (len(quality) and math.isnan(quality[i]))
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
def _frames_agree(along: Array, k: int, ahead: Array, behind: Array) -> None:
    """For matches i and j = i + k: how well j agrees with i -> ahead[i], i with j -> behind[i]."""
    noise, sharpness, tiny = NOISE32, SHARPNESS32, MIN_SQUARE32
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
        t = ONE32 + error / (length * length) * sharpness
        t = t * t
        t = t * t
        t = t * t
        ahead[i] = ONE32 / t
        length = length0 * S[j] + length1 + noise
        t = ONE32 + error / (length * length) * sharpness
        t = t * t
        t = t * t
        t = t * t
        behind[i] = ONE32 / t


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
