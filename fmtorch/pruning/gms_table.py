"""Where matches go from cell to cell of two coarse grids: the tables that GMS counts in."""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

GRID = 20  # cells a side in image 0
CELLS = GRID * GRID
# Cells a side in image 1 at the scale ratios 1, 1/2, 1/sqrt(2), sqrt(2), 2, rounded down as the released code does.
GRIDS = (20, 10, 14, 28, 40)
# The neighbourhood as (dx, dy): eight cells clockwise from the top left, then the centre. A rotation by 45 degrees
# moves the ring on by one.
_RING = ((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (0, 0))
_TABLE_CPU, _TABLE_GPU = 2**22, 2**28  # entries of the table of moves that are in memory at a time

Border = Literal["opencv", "authors"]


def moves_in_blocks(
    x0: Tensor, x1: Tensor, size0: Tensor, size1: Tensor, mask: Tensor | None, grids: tuple[int, ...], border: Border
) -> Iterator[tuple[Moves, Int[Tensor, " m"]]]:
    """The moves of as many pairs at a time as the table may hold, and the places of their matches in (B * N)."""
    p0, p1 = _normalized(x0, size0), _normalized(x1, size1)
    alive = _inside_unit(p0) & _inside_unit(p1)
    alive = alive if mask is None else alive & mask
    entries = 4 * CELLS * sum(g * g for g in grids)
    pairs = max(1, (_TABLE_CPU if x0.device.type == "cpu" else _TABLE_GPU) // entries)
    for start in range(0, len(x0), pairs):
        block = alive[start : start + pairs]
        pair, match = block.nonzero().unbind(-1)
        place = (start + pair) * x0.shape[1] + match
        points0, points1 = (p.flatten(1).index_select(1, place) for p in (p0, p1))
        yield Moves(_lines(points0, pair, border), _cells(points1, grids), pair, len(block), grids), place


def _normalized(x: Tensor, size: Tensor) -> Float[Tensor, "2 b n"]:
    """Points in units of the image, component first, in float32 as the released code has them."""
    return (x.float() / size.flip(-1)[:, None].float()).movedim(-1, 0).contiguous()


def _inside_unit(p: Tensor) -> Tensor:
    return ((p >= 0) & (p < 1)).all(0)


def _lines(p: Float[Tensor, "2 m"], pair: Int[Tensor, " m"], border: Border) -> Int[Tensor, "4 m"]:
    """Number of each match's cell of image 0 in the four shifted grids, (pair, shift, cell); -1 for no cell."""
    half = (p * (2 * GRID)).floor().int()  # doubling is exact: as if half a cell were added in float64, as in C++
    x, y = torch.stack([half, half + 1], 1) >> 1  # (2, M) each: without and with the shift
    inside_x, inside_y = x < GRID, y < GRID
    if border == "authors":
        inside_x[1] &= x[1] >= 1
        inside_y[1] &= y[1] >= 1
    first = (pair * (4 * CELLS)).int()
    rows = [first + (2 * j) * CELLS + y[j] * GRID for j in (0, 1)]
    cells = [torch.where(inside_y[j] & inside_x[i], rows[j] + (x[i] + i * CELLS), -1) for j in (0, 1) for i in (0, 1)]
    return torch.stack(cells).long()


def _cells(p: Float[Tensor, "2 m"], grids: tuple[int, ...]) -> Int[Tensor, "s m"]:
    """Each match's cell of image 1, in each of the grids."""
    side = torch.tensor(grids, device=p.device)[:, None]
    x, y = (torch.minimum((q * side.float()).floor().long(), side - 1) for q in p)
    return y * side + x


class Moves(NamedTuple):
    """Where M matches of several pairs go: from `line`, a cell of image 0, to `end`, a cell of image 1.

    The table of moves has for each grid of image 1 one row a line, and one more for matches without a cell.
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

    def origins(self) -> Int[Tensor, " s"]:
        """Where the rows of each grid begin in the table."""
        cells = torch.tensor([0, *(g * g for g in self.grids[:-1])], device=self.line.device)
        return cells.cumsum(0) * (self.lines + 1)


class Table(NamedTuple):
    """How many matches go from each line to each cell; `filled`: from each line, the spare one and an empty one last.

    slot: where each match is counted. The last entry of `moves` stays zero.
    """

    moves: Int[Tensor, " t"]
    filled: Int[Tensor, " lines"]
    line: Int[Tensor, "4 m"]
    slot: Int[Tensor, "s places"]


def tabulated(moves: Moves) -> Table:
    """Count the moves; `give_back` the table after use."""
    lines, device = moves.lines, moves.line.device
    line = torch.where(moves.line >= 0, moves.line, lines)
    filled = torch.zeros(lines + 2, dtype=torch.int32, device=device)
    filled.scatter_add_(0, line.flatten(), torch.ones_like(line.flatten(), dtype=torch.int32))

    cells = torch.tensor([g * g for g in moves.grids], device=device)[:, None, None]
    slot = (line * cells + (moves.origins()[:, None] + moves.end)[:, None]).flatten(1)
    counted = torch.int16 if len(moves.pair) < 2**15 else torch.int32
    table = _zeros((lines + 1) * sum(g * g for g in moves.grids) + 1, counted, device)
    table.scatter_add_(0, slot.flatten(), torch.ones_like(slot.flatten(), dtype=counted))
    return Table(table, filled, line, slot)


_scratch = threading.local()  # a table of zeros for each type: to clear its memory is quicker than to have new
_CLEARING = 64  # entries that are cleared one after another in the time of one that is sought out


def _zeros(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A table of zeros, to be given back by `give_back`."""
    kept: Tensor | None = _scratch.__dict__.pop(f"{dtype} {device}", None)
    return torch.zeros(size, dtype=dtype, device=device) if kept is None or len(kept) < size else kept


def give_back(table: Table) -> None:
    """Clear the table for the thread's next one. That of a GPU is too large to keep, and new ones cost little there."""
    if table.moves.device.type != "cpu":
        return
    if table.slot.numel() * _CLEARING < len(table.moves):
        table.moves.index_fill_(0, table.slot.flatten(), 0)
    else:
        table.moves.zero_()
    _scratch.__dict__[f"{table.moves.dtype} cpu"] = table.moves


class Surroundings:
    """The nine cells around each of C lines in image 0, and those around each of C cells in one grid of image 1."""

    def __init__(self, table: Table, moves: Moves, grid: int, line: Int[Tensor, " c"], end: Int[Tensor, " c"]) -> None:
        device, side = str(line.device), moves.grids[grid]
        self.table = table
        inside0, step0 = _ring(GRID, device)
        inside1, self.step1 = _ring(side, device)
        self.inside0 = inside0.index_select(1, line.remainder(CELLS))  # (9, C)
        self.inside1 = inside1.index_select(1, end)
        neighbour = torch.where(self.inside0, line + step0, moves.lines + 1)
        self.start = neighbour * (side * side) + (moves.origins()[grid] + end)
        self.count = table.filled.index_select(0, neighbour.flatten()).reshape(neighbour.shape)

    def turned(self, turn: int) -> tuple[Int[Tensor, " c"], Float[Tensor, " c"]]:
        """The matches that go from each cell around the line to the cell around the end that a rotation pairs it with;
        and the matches of those cells of image 0 whose partner is in its grid, on average over them; 0 for none."""
        partner = [*((j - turn) % 8 for j in range(8)), 8]  # a rotation by 45 degrees moves the ring on by one
        both = self.inside0 & (self.inside1[partner] if turn else self.inside1)
        step1 = self.step1[partner] if turn else self.step1
        slot = torch.where(both, self.start + step1, len(self.table.moves) - 1)
        score = _added(self.table.moves.index_select(0, slot.flatten()).reshape(slot.shape))
        cells = _added(both.view(torch.uint8)).clamp_min(1)
        return score, _added(torch.where(both, self.count, 0)).double() / cells


def _added(rows: Tensor) -> Tensor:
    """The sum over the first axis, in the type of the rows (which `sum` would widen first, at some cost)."""
    return functools.reduce(torch.add, rows.unbind(0))


@functools.cache
def _ring(side: int, device: str) -> tuple[Bool[Tensor, "9 cells"], Int[Tensor, "9 1"]]:
    """Which of the nine cells around each cell of a grid are in the grid, and how far on they are in its numbering."""
    ring = torch.tensor(_RING, device=device).T[..., None]
    cell = torch.arange(side * side, device=device)
    x, y = cell.remainder(side) + ring[0], torch.div(cell, side, rounding_mode="floor") + ring[1]
    return (x >= 0) & (x < side) & (y >= 0) & (y < side), ring[1] * side + ring[0]
