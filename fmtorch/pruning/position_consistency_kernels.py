"""`position_consistency` for one pair, compiled: the same orders and the same sums, in float32."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fmtorch.compiling.arrays import Array, B1x1, F4x1, F4x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.geometry.curves_kernels import curve_order
from fmtorch.pruning.agreement import (
    CURVES32,
    EDGES32,
    FARTHEST32,
    HALF_COSINE32,
    HALF_SINE32,
    IDENTITY,
    MAPS32,
    MIN_SQUARE32,
    MIN_VOTE32,
    MIN_VOTES32,
    NOISE32,
    ONE32,
    SHARPNESS32,
    TWO_TANGENT32,
    WINDOW,
    WORST_RATIO32,
)
from fmtorch.pruning.frame_consistency_kernels import add_products


@kernel
def position_agreement(x0: F4x2, x1: F4x2, quality: F4x1, mask: B1x1, out: F4x1) -> None:
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
        curve_order(
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
