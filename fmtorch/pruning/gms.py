"""Grid-based motion statistics: GMS (Bian et al., CVPR 2017)."""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from fmtorch.core.records import ungraphed
from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.jit.batches import for_each_pair, kernels_serve
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, I8x1, inner, kernel
from fmtorch.pruning.calibration import calibration_of

# Where matches go from cell to cell of two coarse grids: the tables that GMS counts in


GRID = 20  # cells a side in image 0
CELLS = GRID * GRID
# Cells a side in image 1 at the scale ratios 1, 1/2, 1/sqrt(2), sqrt(2), 2, rounded down as the released code does.
GRIDS = (20, 10, 14, 28, 40)
# The cells around a cell as (dx, dy), clockwise from the top left. A rotation by 45 degrees moves the ring on by one.
_RING = ((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0))
_NOWHERE = 2**24  # a cell that is beyond all of a block's, also as a row of them
# Entries of the table of moves, and matches, that are in memory at a time. What a processor counts fits its cache.
_BLOCK_CPU, _BLOCK_GPU = (2**22, 2**14), (2**28, 2**24)

Border = Literal["opencv", "authors"]


def moves_in_blocks(
    x0: Tensor, x1: Tensor, size0: Tensor, size1: Tensor, mask: Tensor | None, grids: tuple[int, ...], border: Border
) -> Iterator[tuple[Moves, Int[Tensor, " m"]]]:
    """The moves of as many pairs at a time as the table may hold, and the places of their matches in (B * N)."""
    b, n = x0.shape[:2]
    mask = torch.ones(b, n, dtype=torch.bool, device=x0.device) if mask is None else mask
    table, matches = _BLOCK_CPU if x0.device.type == "cpu" else _BLOCK_GPU
    entries = 4 * CELLS * sum(g * g for g in grids)
    pairs = max(1, min(table // entries, matches // max(1, n)))
    blocks = zip(*(torch.split(a, pairs) for a in (x0, x1, size0, size1, mask)), strict=True)
    for i, (points0, points1, extent0, extent1, mask) in enumerate(blocks if b else ()):
        p = torch.cat([_normalized(points0, extent0), _normalized(points1, extent1)])
        mask = mask & (p.amin(0) >= 0) & (p.amax(0) < 1)
        place = mask.flatten().nonzero()[:, 0]
        pair = torch.arange(len(mask), device=p.device).repeat_interleave(mask.sum(1))
        p = p.flatten(1).index_select(1, place)
        line, end = _lines(p[:2], pair, len(mask), border), _cells(p[2:], grids)
        yield Moves(line, end, pair, len(mask), grids), i * pairs * n + place


def _normalized(x: Tensor, size: Tensor) -> Float[Tensor, "2 b n"]:
    """Points in units of the image, component first, in float32 as the released code has them."""
    return torch.stack([x[..., i].float() / size[:, 1 - i, None].float() for i in (0, 1)])


def _lines(p: Float[Tensor, "2 m"], pair: Int[Tensor, " m"], pairs: int, border: Border) -> Int[Tensor, "4 m"]:
    """Number of each match's cell of image 0 in the four shifted grids, (pair, shift, cell); one more for no cell."""
    x, y = (p * (2 * GRID)).int().unbind()  # doubling is exact: as if half a cell were added in float64, as in C++
    cell = _shifted(border, str(p.device)).index_select(1, y * (2 * GRID) + x)
    return cell.add_((pair * (4 * CELLS)).int()).clamp_(max=pairs * 4 * CELLS)


@functools.cache
def _shifted(border: Border, device: str) -> Int[Tensor, "4 halves"]:
    """The (shift, cell) that each half cell belongs to in the four grids, shifted along neither axis, x, y, both."""
    half = torch.arange(2 * GRID, device=device)
    shifted = half + 1 >> 1
    outside = shifted >= GRID if border == "opencv" else (shifted >= GRID) | (shifted < 1)
    along = torch.stack([half >> 1, shifted.masked_fill(outside, _NOWHERE)])  # (2, 40)
    cells = torch.arange(4, device=device).view(2, 2, 1, 1) * CELLS + along[:, None, :, None] * GRID + along[:, None]
    return cells.flatten(0, 1).flatten(1).int()


def _cells(p: Float[Tensor, "2 m"], grids: tuple[int, ...]) -> Int[Tensor, "s m"]:
    """Each match's cell of image 1, in each of the grids. (The product of a number below 1 and a side is below it.)"""
    side = torch.tensor(grids, dtype=torch.int32, device=p.device)[:, None]
    x, y = ((q * side).int() for q in p.unbind())
    return y.mul_(side).add_(x)


class Moves(NamedTuple):
    """Where M matches of several pairs go: from `line`, a cell of image 0 in one of its grids, to `end`, a cell
    of image 1. Matches without a cell in a grid of image 0 have a spare line, the last.

    The table of moves begins with an entry that stays zero, and has for each grid of image 1 one row a line, and one
    more for matches without a cell.
    """

    line: Int[Tensor, "4 m"]
    end: Int[Tensor, "s m"]
    pair: Int[Tensor, " m"]
    pairs: int
    grids: tuple[int, ...]

    @property
    def lines(self) -> int:
        """Lines of one grid, without the spare one, which is last."""
        return self.pairs * 4 * CELLS

    def origin(self, grid: int) -> int:
        """Where the rows of a grid begin in the table; beyond the last grid, the size of the table."""
        return 1 + sum(g * g for g in self.grids[:grid]) * (self.lines + 1)


class Table(NamedTuple):
    """How many matches go from each line to each cell; `filled`: from each line, 0 for the spare one.

    slot: where each match is counted, for each grid of image 1.
    """

    moves: Int[Tensor, " t"]
    filled: Int[Tensor, " lines"]
    slot: list[Int[Tensor, " places"]]


def tabulated(moves: Moves) -> Table:
    """Count the moves; `give_back` the table after use."""
    line, lines, device = moves.line, moves.lines, moves.line.device
    filled = torch.bincount(line.flatten(), minlength=lines + 1).int()
    filled[lines] = 0
    slot = [
        (line * (side * side)).add_(end + moves.origin(grid)).flatten().long()
        for grid, (side, end) in enumerate(zip(moves.grids, moves.end, strict=True))
    ]
    counted = torch.int16 if len(moves.pair) < 2**15 else torch.int32
    table = _zeros(moves.origin(len(moves.grids)), counted, device)
    ones = torch.ones(line.numel(), dtype=counted, device=device)
    for indices in slot:
        table.scatter_add_(0, indices, ones)
    return Table(table, filled, slot)


_scratch = threading.local()  # a table of zeros for each type: to clear its memory is quicker than to have new
_CLEARING = 64  # entries that are cleared one after another in the time of one that is sought out


def _zeros(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A table of zeros, to be given back by `give_back`."""
    kept: Tensor | None = _scratch.__dict__.pop(f"{dtype} {device}", None)
    if kept is not None and len(kept) >= size:
        return kept
    with torch.inference_mode(False):  # what is kept is changed in either mode
        return torch.zeros(size, dtype=dtype, device=device)


def give_back(table: Table) -> None:
    """Clear the table for the thread's next one. That of a GPU is too large to keep, and new ones cost little there."""
    if table.moves.device.type != "cpu":
        return
    if sum(map(len, table.slot)) * _CLEARING < len(table.moves):
        for slot in table.slot:
            table.moves.index_fill_(0, slot, 0)
    else:
        table.moves.zero_()
    _scratch.__dict__[f"{table.moves.dtype} cpu"] = table.moves


class Surroundings:
    """The nine cells around each of C lines in image 0, and those around each of C cells in one grid of image 1."""

    def __init__(self, table: Table, moves: Moves, grid: int, line: Int[Tensor, " c"], end: Int[Tensor, " c"]) -> None:
        device, side = str(line.device), moves.grids[grid]
        self.moves = table.moves
        inside0, step0 = _ring(GRID, device)
        inside1, step1 = _ring(side, device)
        self.inside0 = inside0.index_select(1, line.remainder(CELLS))  # (8, C)
        self.inside1 = inside1.index_select(1, end).repeat(2, 1)  # (16, C), so that every turn of the ring is a slice
        self.step1 = step1.repeat(2, 1)
        row = side * side
        self.centre = torch.add(end, line, alpha=row).add_(moves.origin(grid))
        self.start = self.centre + step0 * row
        self.filled = table.filled.index_select(0, line)
        around = (line + step0).clamp_(0, moves.lines)  # where this is another line, it is not inside
        self.around = table.filled.index_select(0, around.flatten()).view_as(around)
        self.score = self.moves.index_select(0, self.centre)

    def turned(self, turn: int) -> tuple[Int[Tensor, " c"], Float[Tensor, " c"]]:
        """The matches that go from each cell around the line to the cell around the end that a rotation pairs it with;
        and the matches of those cells of image 0 whose partner is in its grid, on average over them; 0 for none."""
        partner = slice(8 - turn, 16 - turn)  # a rotation by 45 degrees moves the ring on by one
        both = self.inside0 & self.inside1[partner]
        slot = (self.start + self.step1[partner]).bitwise_and_(both)  # 0, the entry that stays zero, for no cell
        score = _added(self.moves.index_select(0, slot.flatten()).view_as(slot)).add_(self.score)
        cells = 1 - _added(both)
        return score, _added(both.bitwise_and_(self.around)).add_(self.filled).double() / cells


def _added(rows: Tensor) -> Tensor:
    """The sum over the first axis, in the type of the rows (which `sum` would widen first, at some cost)."""
    return functools.reduce(torch.add, rows.unbind(0))


@functools.cache
def _ring(side: int, device: str) -> tuple[Int[Tensor, "8 cells"], Int[Tensor, "8 1"]]:
    """Which of the eight cells around each cell of a grid are in the grid, as masks of all bits (-1) or none (0), and
    how far on they are in its numbering."""
    dx, dy = torch.tensor(_RING, dtype=torch.int32, device=device).T[..., None]
    cell = torch.arange(side * side, device=device)
    x, y = cell.remainder(side) + dx, torch.div(cell, side, rounding_mode="floor") + dy
    return -((x >= 0) & (x < side) & (y >= 0) & (y < side)).int(), dy * side + dx


# `gms` for one pair, compiled: the same decisions


HALF_SUPPORT = 1.5  # the score, in square roots of the mean, whose support is one half
RING = np.array(((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0)))


class Matches(NamedTuple):
    """The matches of one pair, x0, x1 (n, 2), which are real, mask (n,), and the images' (h, w); all in pixels."""

    x0: F8x2
    x1: F8x2
    size0: F8x1
    size1: F8x1
    mask: B1x1


@kernel
def gms_kernel(matches: Matches, sides: I8x1, turns: int, factor: float, authors: bool, out: B1x1) -> None:
    """`gms.gms` of n matches -> out (n,).

    sides: cells a side of the grids in image 1. authors: whose rule at the border holds.
    """
    match, p0, p1 = _inside(matches)
    bits, winner = _standing_kernel(p0, p1, sides, turns, factor, authors)
    out[:] = False
    for i in range(len(match)):
        out[match[i]] = (bits[winner // turns, i] >> (winner % turns)) & 1


@kernel
def gms_support_kernel(matches: Matches, sides: I8x1, turns: int, factor: float, authors: bool, out: F8x1) -> None:
    """`gms.gms_support` of n matches -> out (n,); arguments as `gms`."""
    match, p0, p1 = _inside(matches)
    out[:] = 0
    m, winner = len(match), 0
    if len(sides) * turns > 1:
        _, winner = _standing_kernel(p0, p1, sides, turns, factor, authors)
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
def _standing_kernel(
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


def gms(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    *,
    size0: Int[Tensor, "b 2"],
    size1: Int[Tensor, "b 2"],
    mask: Bool[Tensor, "b n"] | None = None,
    with_rotation: bool = False,
    with_scale: bool = False,
    threshold_factor: float = 6.0,
    border: Border = "opencv",
) -> Bool[Tensor, "b n"]:
    """True for matches whose neighbours move with them, as counted on coarse grids.

    Each of four shifted 20 x 20 grids in image 0 assigns every cell the cell of image 1 that most of its matches go
    to; the assignment stands when the nine cells around move likewise often enough,
    ``score >= threshold_factor * sqrt(mean matches of the nine cells)``. A match is kept when it
    follows the assignment of its cell in one of the grids. with_rotation tries eight rotations of the neighbourhood,
    with_scale five sizes of the grid in image 1; the hypothesis that keeps most matches wins, the first of equals.

    x0, x1 in pixels, size0, size1 as (h, w). Matches outside their images' grids are dropped. Masks equal those of
    OpenCV's matchGMS; border="authors" gives those of the authors' code, which drops points in the left and top half
    cells of shifted grids. Time and memory are linear in the number of matches, besides a table of cell pairs whose
    size is bounded.
    """
    grids, turns = GRIDS if with_scale else GRIDS[:1], 8 if with_rotation else 1
    if kernels_serve(x0.detach(), x1.detach()):
        out = torch.empty(x0.shape[:2], dtype=torch.bool)
        options = (np.array(grids), turns, threshold_factor, border == "authors")
        tensors = _per_pair(x0, x1, size0, size1, mask)
        return for_each_pair(gms_kernel, tensors, *options, out=out, kind=torch.float64, group=Matches)
    kept = torch.zeros(x0.shape[:2], dtype=torch.bool, device=x0.device)
    for moves, place in moves_in_blocks(x0, x1, size0, size1, mask, grids, border):
        table = tabulated(moves)
        bits = _standing(table, moves, turns, threshold_factor)
        searched = len(grids) * turns > 1
        kept.view(-1)[place] = _kept(bits, _winner(bits, moves, turns), moves, turns) if searched else bits[0] > 0
        give_back(table)
    return kept


def gms_support(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    *,
    size0: Int[Tensor, "b 2"],
    size1: Int[Tensor, "b 2"],
    mask: Bool[Tensor, "b n"] | None = None,
    with_rotation: bool = False,
    with_scale: bool = False,
    threshold_factor: float = 6.0,
    border: Border = "opencv",
) -> Float[Tensor, "b n"]:
    """How many neighbours move with each match, against how many would suffice by the square root; in [0, 1).

    In each of the four grids, ``z = (score - 1) / sqrt(mean matches of the nine cells, at least 1)``, where the score
    counts the matches, itself included, of the nine cells around that go where the match's own cells say: the paper's
    S_i for each match instead of for the assignment of its cell. The support is ``z / (z + 1.5)`` of the mean z over
    the grids; 0 for a match that is alone, outside or masked. Rotation and scale are those of the hypothesis that keeps
    most matches of the pair in `gms`, whose arguments these are.
    """
    grids, turns = GRIDS if with_scale else GRIDS[:1], 8 if with_rotation else 1
    if kernels_serve(x0.detach(), x1.detach()):
        out = torch.empty(x0.shape[:2], dtype=torch.float64)
        options = (np.array(grids), turns, threshold_factor, border == "authors")
        tensors = _per_pair(x0, x1, size0, size1, mask)
        for_each_pair(gms_support_kernel, tensors, *options, out=out, kind=torch.float64, group=Matches)
        return out.to(x0.dtype)
    support = torch.zeros(x0.shape[:2], dtype=x0.dtype, device=x0.device)
    for moves, place in moves_in_blocks(x0, x1, size0, size1, mask, grids, border):
        table = tabulated(moves)
        winner = torch.zeros(moves.pairs, dtype=torch.int64, device=x0.device)
        if len(grids) * turns > 1:
            winner = _winner(_standing(table, moves, turns, threshold_factor), moves, turns)
        z = _own_support(table, moves, winner, turns)
        give_back(table)
        support.view(-1)[place] = (z / (z + HALF_SUPPORT)).to(support.dtype)
    return support


def _per_pair(x0: Tensor, x1: Tensor, size0: Tensor, size1: Tensor, mask: Tensor | None) -> tuple[Tensor, ...]:
    """What the kernels are given of each pair."""
    mask = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    return x0, x1, size0.float(), size1.float(), mask


def _standing(table: Table, moves: Moves, turns: int, factor: float) -> UInt8[Tensor, "s m"]:
    """The rotations, as bits, under which a match follows an assignment that stands, for each grid of image 1."""
    line, lines = moves.line.flatten().long(), moves.lines
    occupied = table.filled.nonzero()[:, 0].int()
    rows = []
    for grid, (side, slot, end) in enumerate(zip(moves.grids, table.slot, moves.end, strict=True)):
        # The cell of image 1 that most matches of a line go to: largest count, then lowest cell.
        cells = side * side
        counted = torch.int32 if len(end) * cells < 2**31 else torch.int64
        merit = (cells - 1 - end).to(counted) + table.moves.index_select(0, slot).to(counted).mul_(cells).view(4, -1)
        best = merit.new_zeros(lines + 1).scatter_reduce_(0, line, merit.flatten(), "amax")
        assigned = (cells - 1 - best.index_select(0, occupied).remainder(cells)).int()
        around = Surroundings(table, moves, grid, occupied, assigned)
        stands = torch.zeros_like(assigned)
        for turn in range(turns):
            score, mean = around.turned(turn)
            stands |= (score >= factor * sqrt(mean)).int() << turn
        verdict = stands.new_zeros(lines + 1)  # best cell and, in the low byte, bit k: it stands under rotation k
        verdict.index_copy_(0, occupied.long(), (assigned << 8) + stands)
        differs = verdict.index_select(0, line).view(4, -1) ^ (end << 8)  # bits beyond the low byte: another cell
        bits = differs.clamp_(max=256).to(torch.uint8)
        rows.append(bits[0] | bits[1] | bits[2] | bits[3])
    return torch.stack(rows)


def _winner(bits: UInt8[Tensor, "s m"], moves: Moves, turns: int) -> Int[Tensor, " pairs"]:
    """The hypothesis, grid * turns + turn, that keeps most matches of each pair, the first of equals."""
    hypotheses = torch.stack([(row >> turn) & 1 for row in bits for turn in range(turns)], 1)  # (M, S * turns)
    counts = torch.zeros(moves.pairs, hypotheses.shape[1], dtype=torch.int32, device=bits.device)
    counts.index_add_(0, moves.pair, hypotheses.int())
    return counts.argmax(1)


def _kept(bits: UInt8[Tensor, "s m"], winner: Int[Tensor, " pairs"], moves: Moves, turns: int) -> Bool[Tensor, " m"]:
    """What the winning hypothesis of its pair says of each match."""
    chosen = winner[moves.pair]
    row = bits.gather(0, torch.div(chosen, turns, rounding_mode="floor")[None])[0]
    return ((row >> chosen.remainder(turns).to(torch.uint8)) & 1).bool()


def _own_support(table: Table, moves: Moves, winner: Int[Tensor, " pairs"], turns: int) -> Float[Tensor, " m"]:
    """``(score - 1) / sqrt(mean)`` of each match's own cells under its pair's hypothesis, mean over the four grids."""
    chosen = winner[moves.pair]
    total = torch.zeros(len(chosen), dtype=torch.float64, device=chosen.device)
    for hypothesis in sorted(set(winner.tolist())):
        grid, turn = divmod(hypothesis, turns)
        members = (chosen == hypothesis).nonzero()[:, 0]
        for line in moves.line:
            here = members[line[members] < moves.lines]
            score, mean = Surroundings(table, moves, grid, line[here], moves.end[grid, here]).turned(turn)
            total.index_add_(0, here, (score - 1).clamp_min(0) / sqrt(mean.clamp_min(1)) / 4)
    return total


class GMS:
    """`gms` as a stage; or, `soft`, a stage that keeps every match and supplies ``prior``: P(inlier) by `gms_support`.

    calibration: of the support, see `Calibration`; needed by the soft form alone. The other options are those of `gms`.
    Raises ValueError for the soft form without a calibration, and for correspondences without image sizes.
    """

    def __init__(
        self,
        *,
        with_rotation: bool = False,
        with_scale: bool = False,
        threshold_factor: float = 6.0,
        border: Border = "opencv",
        soft: bool = False,
        calibration: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        self.with_rotation, self.with_scale = with_rotation, with_scale
        self.threshold_factor, self.border = threshold_factor, border
        self.calibration = calibration_of("GMS", soft, calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only those survive that move with their neighbours, or with a prior."""
        return ungraphed(c, lambda: self._pruned(c))

    def _pruned(self, c: Correspondences) -> Correspondences:
        return self.calibration(c, self.evidence(c)) if self.calibration else c.keep(gms(**self._arguments(c)))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from: `gms_support`."""
        return gms_support(**self._arguments(c))

    def _arguments(self, c: Correspondences) -> dict[str, Any]:
        if c.size0 is None or c.size1 is None:
            raise ValueError("GMS needs `size0` and `size1`: its grids divide the images")
        return {
            "x0": c.x0, "x1": c.x1, "size0": c.size0, "size1": c.size1, "mask": c.mask,
            "with_rotation": self.with_rotation, "with_scale": self.with_scale,
            "threshold_factor": self.threshold_factor, "border": self.border,
        }  # fmt: skip
