"""Where matches go from cell to cell of two coarse grids: the tables that GMS counts in."""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

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
