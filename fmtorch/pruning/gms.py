"""Grid-based motion statistics: GMS (Bian et al., CVPR 2017)."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from fmtorch.pruning.calibration import calibration_of
from fmtorch.types import Correspondences

GRID = 20  # cells a side in image 0
_CELLS = GRID * GRID
# Cells a side in image 1 at the scale ratios 1, 1/2, 1/sqrt(2), sqrt(2), 2, rounded down as the released code does.
_GRIDS = (20, 10, 14, 28, 40)
# The neighbourhood as (dx, dy): eight cells clockwise from the top left, then the centre. A rotation by 45 degrees
# moves the ring on by one.
_RING = ((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (0, 0))
_TABLE_CPU, _TABLE_GPU = 2**22, 2**28  # entries of the table of moves that are in memory at a time
_HALF_SUPPORT = 1.5  # the score, in square roots of the mean, whose support is one half

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
    ``score >= threshold_factor * sqrt(mean matches of the nine cells)``. A match is kept when it
    follows the assignment of its cell in one of the grids. with_rotation tries eight rotations of the neighbourhood,
    with_scale five sizes of the grid in image 1; the hypothesis that keeps most matches wins, the first of equals.

    x0, x1 in pixels, size0, size1 as (h, w). Matches outside their images' grids are dropped. Masks equal those of
    OpenCV's matchGMS; border="authors" gives those of the authors' code, which drops points in the left and top half
    cells of shifted grids. Time and memory are linear in the number of matches, besides a table of cell pairs whose
    size is bounded.
    """
    grids, turns = _GRIDS if with_scale else _GRIDS[:1], 8 if with_rotation else 1
    kept = torch.zeros(x0.shape[:2], dtype=torch.bool, device=x0.device)
    for moves, place in _blocks(x0, x1, size0, size1, mask, grids, border):
        table = _tabulated(moves)
        bits = _standing(table, moves, turns, threshold_factor)
        kept.view(-1)[place] = _kept(bits, _winner(bits, moves, turns), moves, turns)
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

    In each of the four grids, ``z = (score - 1) / sqrt(mean matches of the nine cells)``, where the score counts the
    matches, itself included, of the nine cells around that go where the match's own cells say: the paper's S_i for each
    match instead of for the assignment of its cell. The support is ``z / (z + 1.5)`` of the mean z over the grids; 0
    for a match that is alone, outside or masked. Rotation and scale are those of the hypothesis that keeps most matches
    of the pair in `gms`, whose arguments these are.
    """
    grids, turns = _GRIDS if with_scale else _GRIDS[:1], 8 if with_rotation else 1
    support = torch.zeros(x0.shape[:2], dtype=x0.dtype, device=x0.device)
    for moves, place in _blocks(x0, x1, size0, size1, mask, grids, border):
        table = _tabulated(moves)
        winner = torch.zeros(moves.pairs, dtype=torch.int64, device=x0.device)
        if len(grids) * turns > 1:
            winner = _winner(_standing(table, moves, turns, threshold_factor), moves, turns)
        z = _own_support(table, moves, winner, turns)
        support.view(-1)[place] = (z / (z + _HALF_SUPPORT)).to(support.dtype)
    return support


def _blocks(
    x0: Tensor, x1: Tensor, size0: Tensor, size1: Tensor, mask: Tensor | None, grids: tuple[int, ...], border: Border
) -> Iterator[tuple[_Moves, Int[Tensor, " m"]]]:
    """The moves of as many pairs at a time as the table may hold, and the places of their matches in (B * N)."""
    p0, p1 = _normalized(x0, size0), _normalized(x1, size1)
    alive = _inside_unit(p0) & _inside_unit(p1)
    alive = alive if mask is None else alive & mask
    entries = 4 * _CELLS * sum(g * g for g in grids)
    pairs = max(1, (_TABLE_CPU if x0.device.type == "cpu" else _TABLE_GPU) // entries)
    for start in range(0, len(x0), pairs):
        block = alive[start : start + pairs]
        pair, match = block.nonzero().unbind(-1)
        place = (start + pair) * x0.shape[1] + match
        points0, points1 = (p.flatten(1).index_select(1, place) for p in (p0, p1))
        yield _Moves(_lines(points0, pair, border), _cells(points1, grids), pair, len(block), grids), place


def _normalized(x: Tensor, size: Tensor) -> Float[Tensor, "2 b n"]:
    """Points in units of the image, component first, in float32 as the released code has them."""
    return (x.float() / size.flip(-1)[:, None].float()).movedim(-1, 0).contiguous()


def _inside_unit(p: Tensor) -> Tensor:
    return ((p >= 0) & (p < 1)).all(0)


def _lines(p: Float[Tensor, "2 m"], pair: Int[Tensor, " m"], border: Border) -> Int[Tensor, "4 m"]:
    """Number of each match's cell of image 0 in the four shifted grids, (pair, shift, cell); -1 for no cell."""
    shift = torch.tensor([0.0, 0.5], dtype=torch.float64, device=p.device)[:, None]
    place = ((p * GRID)[:, None] + shift).floor().long()  # (2, 2, M); the shift is added in float64, as in C++
    inside = place < GRID
    if border == "authors":
        inside[:, 1] &= place[:, 1] >= 1
    cell = (place[1, :, None] * GRID + place[0]).flatten(0, 1)
    shifts = torch.arange(4, device=p.device)[:, None]
    return torch.where((inside[1, :, None] & inside[0]).flatten(0, 1), (pair * 4 + shifts) * _CELLS + cell, -1)


def _cells(p: Float[Tensor, "2 m"], grids: tuple[int, ...]) -> Int[Tensor, "s m"]:
    """Each match's cell of image 1, in each of the grids."""
    side = torch.tensor(grids, device=p.device)[:, None]
    x, y = (torch.minimum((q * side.float()).floor().long(), side - 1) for q in p)
    return y * side + x


class _Moves(NamedTuple):
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
        return self.pairs * 4 * _CELLS

    def origins(self) -> Int[Tensor, " s"]:
        """Where the rows of each grid begin in the table."""
        cells = torch.tensor([0, *(g * g for g in self.grids[:-1])], device=self.line.device)
        return cells.cumsum(0) * (self.lines + 1)


class _Table(NamedTuple):
    """How many matches go from each line to each cell; `filled`: from each line, the spare one included.

    slot (S * 4 * M): where each match is counted. The last entry of `moves` stays zero.
    """

    moves: Int[Tensor, " t"]
    filled: Int[Tensor, " lines"]
    line: Int[Tensor, "4 m"]
    slot: Int[Tensor, " sm"]


def _tabulated(moves: _Moves) -> _Table:
    lines, device = moves.lines, moves.line.device
    line = torch.where(moves.line >= 0, moves.line, lines)
    filled = torch.zeros(lines + 1, dtype=torch.int64, device=device)
    filled.scatter_add_(0, line.flatten(), torch.ones_like(line).flatten())

    cells = torch.tensor([g * g for g in moves.grids], device=device)[:, None, None]
    slot = (line * cells + (moves.origins()[:, None] + moves.end)[:, None]).flatten()
    counted = torch.int16 if len(moves.pair) < 2**15 else torch.int32
    table = torch.zeros((lines + 1) * int(cells.sum()) + 1, dtype=counted, device=device)
    table.scatter_add_(0, slot, torch.ones_like(slot, dtype=counted))
    return _Table(table, filled, line, slot)


def _standing(table: _Table, moves: _Moves, turns: int, factor: float) -> UInt8[Tensor, "s m"]:
    """The rotations, as bits, under which a match follows an assignment that stands, for each grid of image 1."""
    s, lines, line, device = len(moves.grids), moves.lines, table.line, moves.line.device
    # The cell of image 1 that most matches of a line go to: largest count, then lowest cell.
    base = max(moves.grids) ** 2
    merit = table.moves.gather(0, table.slot).long().reshape(s, -1) * base + (base - 1 - moves.end.repeat(1, 4))
    best = torch.zeros(s, lines + 1, dtype=torch.int64, device=device)
    best.scatter_reduce_(1, line.reshape(1, -1).expand(s, -1), merit, "amax")
    best = base - 1 - best.remainder(base)

    grid, occupied = (table.filled[:-1] > 0).expand(s, -1).nonzero().unbind(-1)
    verdict = torch.zeros_like(best)  # best cell and, in the low byte, bit k: the assignment stands under rotation k
    verdict[grid, occupied] = best[grid, occupied] * 256 + _verify(
        table.moves, table.filled, moves, grid, occupied, best[grid, occupied], turns, factor
    )
    found = verdict.gather(1, line.reshape(1, -1).expand(s, -1)).reshape(s, *line.shape)
    bits = torch.where(found >> 8 == moves.end[:, None], found & 255, 0).to(torch.uint8)
    return bits[:, 0] | bits[:, 1] | bits[:, 2] | bits[:, 3]


def _verify(
    table: Tensor,
    filled: Int[Tensor, " lines"],
    moves: _Moves,
    grid: Int[Tensor, " c"],
    line: Int[Tensor, " c"],
    best: Int[Tensor, " c"],
    turns: int,
    factor: float,
) -> Int[Tensor, " c"]:
    """The rotations under which the neighbours of each occupied line agree with its best cell, as bits."""
    ring, partner = _neighbourhood(turns, str(line.device))
    side = torch.tensor(moves.grids, device=line.device)[grid]
    inside0, step0 = _around(line.remainder(_CELLS), torch.full_like(line, GRID), ring)  # (9, C)
    inside1, step1 = _around(best, side, ring)
    neighbour = torch.where(inside0, line + step0, line)
    start = moves.origins()[grid] + best + neighbour * side * side
    count = filled.gather(0, neighbour.flatten()).reshape(neighbour.shape)
    stands = torch.zeros_like(line)
    for turn in range(turns):  # nine rows each, which all rotations share
        both = inside0 & inside1[partner[turn]]
        slot = torch.where(both, start + step1[partner[turn]], len(table) - 1)
        score = table.gather(0, slot.flatten()).reshape(slot.shape).sum(0)
        mean = torch.where(both, count, 0).sum(0).double() / both.sum(0)
        stands |= (score >= factor * mean.sqrt()).long() << turn
    return stands


@functools.cache
def _neighbourhood(turns: int, device: str) -> tuple[Tensor, Tensor]:
    """The ring (2, 9, 1), and for each rotation the cells of image 1's ring that belong to image 0's (turns, 9)."""
    partner = [[*((j - turn) % 8 for j in range(8)), 8] for turn in range(turns)]
    return torch.tensor(_RING, device=device).T[..., None].contiguous(), torch.tensor(partner, device=device)


def _around(cell: Tensor, side: Tensor, ring: Tensor) -> tuple[Tensor, Tensor]:
    """Which of the nine cells around each cell are in its grid, and how far on they are in the cells' numbering."""
    x, y = cell.remainder(side) + ring[0], torch.div(cell, side, rounding_mode="floor") + ring[1]
    inside = (x >= 0) & (x < side) & (y >= 0) & (y < side)
    return inside, ring[1] * side + ring[0]


def _winner(bits: UInt8[Tensor, "s m"], moves: _Moves, turns: int) -> Int[Tensor, " pairs"]:
    """The hypothesis, grid * turns + turn, that keeps most matches of each pair, the first of equals."""
    hypotheses = torch.stack([(row >> turn) & 1 for row in bits for turn in range(turns)], 1)  # (M, S * turns)
    counts = torch.zeros(moves.pairs, hypotheses.shape[1], dtype=torch.int32, device=bits.device)
    counts.index_add_(0, moves.pair, hypotheses.int())
    return counts.argmax(1)


def _kept(bits: UInt8[Tensor, "s m"], winner: Int[Tensor, " pairs"], moves: _Moves, turns: int) -> Bool[Tensor, " m"]:
    """What the winning hypothesis of its pair says of each match."""
    chosen = winner[moves.pair]
    row = bits.gather(0, torch.div(chosen, turns, rounding_mode="floor")[None])[0]
    return ((row >> chosen.remainder(turns).to(torch.uint8)) & 1).bool()


def _own_support(
    table: _Table, moves: _Moves, winner: Int[Tensor, " pairs"], turns: int
) -> Float[Tensor, " m"]:
    """``(score - 1) / sqrt(mean)`` of each match's own cells under its pair's hypothesis, mean over the four grids."""
    ring, partner = _neighbourhood(turns, str(moves.line.device))
    chosen = winner[moves.pair]
    grid, turn = torch.div(chosen, turns, rounding_mode="floor"), chosen.remainder(turns)
    side = torch.tensor(moves.grids, device=chosen.device)[grid]
    end = moves.end.gather(0, grid[None])[0]
    inside1, step1 = (v.gather(0, partner[turn].T) for v in _around(end, side, ring))
    total = torch.zeros(len(chosen), dtype=torch.float64, device=chosen.device)
    for line in table.line:
        inside0, step0 = _around(line.remainder(_CELLS), torch.full_like(line, GRID), ring)  # (9, M)
        both = inside0 & inside1 & (line < moves.lines)
        neighbour = torch.where(inside0 & (line < moves.lines), line + step0, line)
        slot = torch.where(both, moves.origins()[grid] + neighbour * side * side + end + step1, len(table.moves) - 1)
        score = table.moves.gather(0, slot.flatten()).reshape(slot.shape).sum(0)
        count = torch.where(both, table.filled.gather(0, neighbour.flatten()).reshape(neighbour.shape), 0).sum(0)
        mean = count.double() / both.sum(0).clamp_min(1)
        total = total + (score - 1).clamp_min(0) / mean.clamp_min(1).sqrt()
    return total / 4


class GMS:
    """`gms` as a stage, which may also supply ``prior``: P(inlier) from `gms_support`.

    calibration: of the support, see `Calibration`; None: no prior. prune: False keeps every match and gives the prior
    only; raises ValueError where there is no calibration then. The other options are those of `gms`. Raises ValueError
    for correspondences without image sizes.
    """

    def __init__(
        self,
        *,
        with_rotation: bool = False,
        with_scale: bool = False,
        threshold_factor: float = 6.0,
        border: Border = "opencv",
        prune: bool = True,
        calibration: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        self._options: dict[str, Any] = {
            "with_rotation": with_rotation, "with_scale": with_scale,
            "threshold_factor": threshold_factor, "border": border,
        }  # fmt: skip
        self.prune = prune
        self.calibration = calibration_of("GMS", prune, calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only those survive that move with their neighbours, or with a prior."""
        soft = c if self.calibration is None else self.calibration(c, self.evidence(c))
        return soft.keep(gms(**self._arguments(c))) if self.prune else soft

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from: `gms_support`."""
        return gms_support(**self._arguments(c))

    def _arguments(self, c: Correspondences) -> dict[str, Any]:
        if c.size0 is None or c.size1 is None:
            raise ValueError("GMS needs `size0` and `size1`: its grids divide the images")
        return {"x0": c.x0, "x1": c.x1, "size0": c.size0, "size1": c.size1, "mask": c.mask, **self._options}
