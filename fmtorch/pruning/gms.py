"""Grid-based motion statistics: GMS (Bian et al., CVPR 2017)."""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.types import Correspondences

GRID = 20  # cells a side in image 0
_CELLS = GRID * GRID
_SHIFTS = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5))  # of the grid in image 0, in cells, (x, y)
# Cells a side in image 1 at the scale ratios 1, 1/2, 1/sqrt(2), sqrt(2), 2, rounded down as the released code does.
_GRIDS = (20, 10, 14, 28, 40)
# The neighbourhood as (dx, dy): eight cells clockwise from the top left, then the centre. A rotation by 45 degrees
# moves the ring on by one.
_RING = ((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (0, 0))
_TABLE = {"cpu": 2**22}  # entries of the table of moves that are in memory at a time; more on a GPU
_TABLE_GPU = 2**28

Border = Literal["opencv", "authors"]


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
    ``score >= threshold_factor * sqrt(mean matches of the nine cells)`` (equations 12-14). A match is kept when it
    follows the assignment of its cell in one of the grids. with_rotation tries eight rotations of the neighbourhood,
    with_scale five sizes of the grid in image 1; the hypothesis that keeps most matches wins, the first of equals.

    x0, x1 in pixels, size0, size1 as (h, w). Matches outside their images' grids are dropped. Masks equal those of
    OpenCV's matchGMS; border="authors" gives those of the authors' code, which drops points in the left and top half
    cells of shifted grids. Time and memory are linear in the number of matches, besides a table of cell pairs whose
    size is bounded.
    """
    kept = torch.zeros(x0.shape[:2], dtype=torch.bool, device=x0.device)
    grids = _GRIDS if with_scale else _GRIDS[:1]
    turns = 8 if with_rotation else 1
    alive = torch.isfinite(x0).all(-1) & torch.isfinite(x1).all(-1)
    alive = alive if mask is None else alive & mask
    p0, p1 = _normalised(x0, size0), _normalised(x1, size1)
    entries = 4 * _CELLS * sum(g * g for g in grids)
    pairs = max(1, _TABLE.get(x0.device.type, _TABLE_GPU) // entries)
    for start in range(0, len(x0), pairs):
        block = slice(start, start + pairs)
        pair, match = alive[block].nonzero().unbind(-1)
        if len(pair):
            moves = _moves(p0[block][pair, match], p1[block][pair, match], pair, grids, border)
            kept[start + pair, match] = _consistent(moves, len(alive[block]), turns, threshold_factor)
    return kept


def _normalised(x: Tensor, size: Tensor) -> Tensor:
    """Points in units of the image, in float32 as the released code has them."""
    return x.float() / size.flip(-1)[:, None].float()


class _Moves(NamedTuple):
    """Where each of M matches goes, for each of S grids in image 1 and four shifts of the grid in image 0."""

    pair: Int[Tensor, " m"]
    start: Int[Tensor, "s 4 m"]  # row of the table: (pair, grid, shift, cell of image 0)
    end: Int[Tensor, "s 1 m"]  # cell of image 1
    inside: Bool[Tensor, "s 4 m"]  # both cells exist
    grids: tuple[int, ...]


def _moves(p0: Tensor, p1: Tensor, pair: Tensor, grids: tuple[int, ...], border: Border) -> _Moves:
    device = p0.device
    shift = torch.tensor(_SHIFTS, dtype=torch.float64, device=device)[:, None]
    place0 = (p0 * GRID + shift).floor().long()  # (4, M, 2); the shift is added in float64, as in C++
    lowest = (shift > 0).long() if border == "authors" else torch.zeros_like(shift, dtype=torch.int64)
    inside0 = ((place0 >= lowest) & (place0 < GRID)).all(-1)
    cell0 = place0[..., 1] * GRID + place0[..., 0]

    side = torch.tensor(grids, device=device)[:, None, None, None]
    place1 = (p1 * side.float()).floor().long()  # (S, 1, M, 2)
    inside1 = ((place1 >= 0) & (place1 < side)).all(-1)
    cell1 = place1[..., 1] * side[..., 0] + place1[..., 0]

    inside = inside0 & inside1
    hypothesis = torch.arange(len(grids), device=device)[:, None, None]
    shifts = torch.arange(4, device=device)[:, None]
    start = ((pair * len(grids) + hypothesis) * 4 + shifts) * _CELLS + cell0
    return _Moves(pair, torch.where(inside, start, 0), cell1, inside, grids)


def _consistent(moves: _Moves, pairs: int, turns: int, factor: float) -> Bool[Tensor, " m"]:
    """Which of the M matches the winning hypothesis of their pair keeps."""
    s, m = len(moves.grids), len(moves.pair)
    rows = pairs * s * 4 * _CELLS
    cells1 = torch.tensor([g * g for g in moves.grids], device=moves.pair.device)
    # The table of moves has one line a row, as long as its grid has cells; lines lie one after another.
    grid_of_row = torch.arange(pairs * s, device=moves.pair.device).remainder(s).repeat_interleave(4 * _CELLS)
    offset = cells1[grid_of_row].cumsum(0) - cells1[grid_of_row]
    start, end = moves.start[moves.inside], moves.end.expand_as(moves.start)[moves.inside]
    counted = torch.int16 if m < 2**15 else torch.int32
    table = torch.zeros(4 * _CELLS * pairs * sum(g * g for g in moves.grids), dtype=counted, device=start.device)
    where = offset[start] + end
    table.index_add_(0, where, torch.ones_like(where, dtype=counted))
    filled = torch.zeros(rows, dtype=torch.int64, device=start.device).index_add_(0, start, torch.ones_like(start))

    # The best cell of image 1, the first of equals: largest count, then lowest cell.
    last = max(moves.grids) ** 2 - 1
    merit = table[where].long() * (last + 1) + (last - end)
    best = torch.zeros_like(filled).scatter_reduce_(0, start, merit, "amax")
    best = last - best.remainder(last + 1)

    occupied = filled.nonzero()[:, 0]
    stands = torch.zeros(rows, dtype=torch.uint8, device=start.device)  # bit k: stands under rotation k
    stands[occupied] = _verify(table, offset, filled, occupied, best, moves.grids, turns, factor)

    bits = torch.zeros(s, 4, m, dtype=torch.uint8, device=start.device)
    bits[moves.inside] = torch.where(best[start] == end, stands[start], 0)
    by_grid = bits[:, 0] | bits[:, 1] | bits[:, 2] | bits[:, 3]
    return _winner(by_grid, moves.pair, pairs, turns)


def _verify(
    table: Tensor,
    offset: Tensor,
    filled: Tensor,
    row: Int[Tensor, " c"],
    best: Tensor,
    grids: tuple[int, ...],
    turns: int,
    factor: float,
) -> Tensor:
    """For each occupied row of the table, the rotations under which its neighbours agree, as bits."""
    ring, partner = _neighbourhood(turns, str(row.device))
    cell0, grid = row.remainder(_CELLS), torch.div(row, 4 * _CELLS, rounding_mode="floor").remainder(len(grids))
    side = torch.tensor(grids, device=row.device)[grid]
    inside0, step0 = _around(cell0, torch.full_like(cell0, GRID), ring)  # (C, 9)
    inside1, step1 = _around(best[row], side, ring)
    neighbour = torch.where(inside0, row[:, None] + step0, row[:, None])
    line = offset[neighbour] + best[row][:, None]
    filled0 = torch.where(inside0, filled[neighbour], 0)
    stands = torch.zeros_like(row, dtype=torch.uint8)
    for turn in range(turns):  # a handful of columns each; the same rows serve all rotations
        both = inside0 & inside1[:, partner[turn]]
        moved = table[torch.where(both, line + step1[:, partner[turn]], 0)]
        score = torch.where(both, moved, 0).sum(1)
        mean = torch.where(both, filled0, 0).sum(1).double() / both.sum(1)
        stands |= (score >= factor * mean.sqrt()).to(torch.uint8) << turn
    return stands


@functools.cache
def _neighbourhood(turns: int, device: str) -> tuple[Tensor, Tensor]:
    """The ring (9, 2), and for each rotation which cell of image 1's ring belongs to each of image 0's (turns, 9)."""
    partner = [[*((j - turn) % 8 for j in range(8)), 8] for turn in range(turns)]
    return torch.tensor(_RING, device=device), torch.tensor(partner, device=device)


def _around(cell: Tensor, side: Tensor, ring: Tensor) -> tuple[Tensor, Tensor]:
    """Which of the nine cells around each cell are in its grid, and how far they are in the cells' numbering."""
    place = torch.stack([cell.remainder(side), torch.div(cell, side, rounding_mode="floor")], -1)[:, None] + ring
    inside = ((place >= 0) & (place < side[:, None, None])).all(-1)
    return inside, ring[:, 1] * side[:, None] + ring[:, 0]


def _winner(bits: Tensor, pair: Tensor, pairs: int, turns: int) -> Tensor:
    """Of hypotheses as (grid, bit), what the one that keeps most matches of the pair keeps; none if that is zero."""
    kept = torch.stack([(bits >> turn) & 1 for turn in range(turns)], 1).flatten(0, 1)  # (S * turns, M)
    counts = torch.zeros(pairs, len(kept), dtype=torch.int64, device=bits.device).index_add_(0, pair, kept.T.long())
    return kept.gather(0, counts.argmax(1)[pair][None])[0].bool()


@dataclasses.dataclass(frozen=True)
class GMS:
    """`gms` as a stage. Raises ValueError for correspondences without image sizes."""

    with_rotation: bool = False
    with_scale: bool = False
    threshold_factor: float = 6.0
    border: Border = "opencv"

    def __call__(self, correspondences: Correspondences) -> Correspondences:
        """The same matches, of which only those survive that move with their neighbours."""
        c = correspondences
        if c.size0 is None or c.size1 is None:
            raise ValueError("GMS needs `size0` and `size1`: its grids divide the images")
        options = dataclasses.asdict(self)
        return c.keep(gms(c.x0, c.x1, size0=c.size0, size1=c.size1, mask=c.mask, **options))
