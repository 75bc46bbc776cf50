"""`gms` for one pair, compiled."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, B1x1, F8x1, F8x2, I8x1
from fmtorch.compiling.kernel import inner, kernel

GRID = 20  # cells a side in image 0
CELLS = GRID * GRID
HALF_SUPPORT = 1.5  # the score, in square roots of the mean, whose support is one half
# The cells around a cell as (dx, dy), clockwise from the top left. A rotation by 45 degrees moves the ring on by one.
RING = np.array(((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0)))


class Matches(NamedTuple):
    """The matches of one pair, x0, x1 (n, 2), which are real, mask (n,), and the images' (h, w); all in pixels."""

    x0: F8x2
    x1: F8x2
    size0: F8x1
    size1: F8x1
    mask: B1x1


@kernel
def gms(matches: Matches, sides: I8x1, turns: int, factor: float, authors: bool, out: B1x1) -> None:
    """`gms.gms` of n matches -> out (n,).

    sides: cells a side of the grids in image 1. authors: whose rule at the border holds.
    """
    match, p0, p1 = _inside(matches)
    bits, winner = _standing(p0, p1, sides, turns, factor, authors)
    out[:] = False
    for i in range(len(match)):
        out[match[i]] = (bits[winner // turns, i] >> (winner % turns)) & 1


@kernel
def gms_support(matches: Matches, sides: I8x1, turns: int, factor: float, authors: bool, out: F8x1) -> None:
    """`gms.gms_support` of n matches -> out (n,); arguments as `gms`."""
    match, p0, p1 = _inside(matches)
    out[:] = 0
    m, winner = len(match), 0
    if len(sides) * turns > 1:
        _, winner = _standing(p0, p1, sides, turns, factor, authors)
    side, turn = sides[winner // turns], winner % turns
    end, line, table, filled = _ends(p1, side), np.empty(m, np.int64), _table(side), np.empty(CELLS, np.int64)
    z = np.zeros(m)
    for shift in range(4):
        _count(p0, end, shift, side, authors, line, table, filled)
        for i in range(m):
            if line[i] >= 0:
                score, mean = _around(table, filled, line[i], end[i], side, turn)
                z[i] += max(score - 1, 0) / math.sqrt(max(mean, 1.0)) / 4
        _clear(line, end, side, table)
    for i in range(m):
        out[match[i]] = z[i] / (z[i] + HALF_SUPPORT)


@inner
def _inside(matches: Matches) -> tuple[Array, Array, Array]:
    """The matches inside both images, (m,), and their points in units of the images, (m, 2), as float32 has them."""
    x0, x1, size0, size1, mask = matches
    n, m = len(mask), 0
    match = np.empty(n, np.int64)
    p0, p1 = np.empty((n, 2), np.float32), np.empty((n, 2), np.float32)
    for i in range(n):
        inside = mask[i]
        for k in range(2):
            p0[m, k] = np.float32(x0[i, k]) / np.float32(size0[1 - k])
            p1[m, k] = np.float32(x1[i, k]) / np.float32(size1[1 - k])
            inside = inside and 0 <= p0[m, k] < 1 and 0 <= p1[m, k] < 1
        match[m] = i
        m += inside
    return match[:m], p0[:m], p1[:m]


@inner
def _ends(p1: Array, side: int) -> Array:
    """Each match's cell of image 1, (m,)."""
    end = np.empty(len(p1), np.int64)
    for i in range(len(p1)):
        end[i] = np.int64(p1[i, 1] * np.float32(side)) * side + np.int64(p1[i, 0] * np.float32(side))
    return end


@inner
def _table(side: int) -> Array:
    """Zeros: the matches from each cell of image 0 to each of image 1."""
    return np.zeros(CELLS * side * side, np.int32)


@inner
def _count(
    p0: Array, end: Array, shift: int, side: int, authors: bool, line: Array, table: Array, filled: Array
) -> None:  # fmt: skip
    """The cells of image 0 in a shifted grid -> line (m,), -1 for none; and the matches that go where, and from where.

    shift: 1 along x, 2 along y, 3 along both.
    """
    filled[:] = 0
    min_cell = 1 if authors else 0
    for i in range(len(p0)):
        x, y = np.int64(p0[i, 0] * np.float32(2 * GRID)), np.int64(p0[i, 1] * np.float32(2 * GRID))
        column, row = (x + (shift & 1)) >> 1, (y + (shift >> 1)) >> 1
        outside = column >= GRID or row >= GRID or (shift & 1 and column < min_cell) or (shift >> 1 and row < min_cell)
        line[i] = -1 if outside else row * GRID + column
        if not outside:
            filled[line[i]] += 1
            table[line[i] * side * side + end[i]] += 1


@inner
def _clear(line: Array, end: Array, side: int, table: Array) -> None:
    """Sets the table to zero again."""
    for i in range(len(line)):
        if line[i] >= 0:
            table[line[i] * side * side + end[i]] = 0


@inner
def _around(table: Array, filled: Array, line: int, end: int, side: int, turn: int) -> tuple[Any, Any]:
    """Matches between the nine cells around two cells, turned; and the mean of matches of those in image 0."""
    score, total, cells = np.int64(table[line * side * side + end]), filled[line], 1
    x0, y0, x1, y1 = line % GRID, line // GRID, end % side, end // side
    for j in range(8):
        k = (j - turn) & 7
        u0, v0, u1, v1 = x0 + RING[j, 0], y0 + RING[j, 1], x1 + RING[k, 0], y1 + RING[k, 1]
        if 0 <= u0 < GRID and 0 <= v0 < GRID and 0 <= u1 < side and 0 <= v1 < side:
            start = v0 * GRID + u0
            score += table[start * side * side + v1 * side + u1]
            total += filled[start]
            cells += 1
    return score, total / cells


@inner
def _standing(
    p0: Array, p1: Array, sides: Array, turns: int, factor: float, authors: bool
) -> tuple[Array, int]:  # fmt: skip
    """The rotations, as bits, under which each match follows an assignment that stands, (grids, m), and the
    hypothesis, grid * turns + turn, that keeps most matches, the first of equals."""
    m, largest = len(p0), 0
    for side in sides:
        largest = max(largest, side)
    bits, table = np.zeros((len(sides), m), np.uint8), _table(largest)
    line, filled = np.empty(m, np.int64), np.empty(CELLS, np.int64)
    assigned, most, stands = np.empty(CELLS, np.int64), np.empty(CELLS, np.int64), np.empty(CELLS, np.uint8)
    winner, kept_by_winner = 0, -1
    for grid in range(len(sides)):
        side = sides[grid]
        end = _ends(p1, side)
        for shift in range(4):
            _count(p0, end, shift, side, authors, line, table, filled)
            most[:] = 0
            for i in range(m):  # most matches, then the lowest cell
                if line[i] >= 0:
                    count = table[line[i] * side * side + end[i]]
                    if count > most[line[i]] or (count == most[line[i]] and end[i] < assigned[line[i]]):
                        most[line[i]], assigned[line[i]] = count, end[i]
            for start in range(CELLS):
                stands[start] = 0
                for turn in range(turns if filled[start] else 0):
                    score, mean = _around(table, filled, start, assigned[start], side, turn)
                    stands[start] |= np.uint8(score >= factor * math.sqrt(mean)) << np.uint8(turn)
            for i in range(m):
                if line[i] >= 0 and end[i] == assigned[line[i]]:
                    bits[grid, i] |= stands[line[i]]
            _clear(line, end, side, table)
        for turn in range(turns):
            kept = 0
            for i in range(m):
                kept += (bits[grid, i] >> turn) & 1
            if kept > kept_by_winner:
                winner, kept_by_winner = grid * turns + turn, kept
    return bits, winner
