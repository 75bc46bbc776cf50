"""Grid-based motion statistics: GMS (Bian et al., CVPR 2017)."""

from __future__ import annotations

import functools
import threading
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
        searched = len(grids) * turns > 1
        kept.view(-1)[place] = _kept(bits, _winner(bits, moves, turns), moves, turns) if searched else bits[0] > 0
        _give_back(table)
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

    In each of the four grids, ``z = (score - 1) / sqrt(mean matches of the nine cells, at least 1)``, where the score counts the
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
        _give_back(table)
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
    half = (p * (2 * GRID)).floor().int()  # doubling is exact: as if half a cell were added in float64, as in C++
    x, y = torch.stack([half, half + 1], 1) >> 1  # (2, M) each: without and with the shift
    inside_x, inside_y = x < GRID, y < GRID
    if border == "authors":
        inside_x[1] &= x[1] >= 1
        inside_y[1] &= y[1] >= 1
    first = (pair * (4 * _CELLS)).int()
    rows = [first + (2 * j) * _CELLS + y[j] * GRID for j in (0, 1)]
    cells = [torch.where(inside_y[j] & inside_x[i], rows[j] + (x[i] + i * _CELLS), -1) for j in (0, 1) for i in (0, 1)]
    return torch.stack(cells).long()


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
    """How many matches go from each line to each cell; `filled`: from each line, the spare one and an empty one last.

    slot: where each match is counted. The last entry of `moves` stays zero.
    """

    moves: Int[Tensor, " t"]
    filled: Int[Tensor, " lines"]
    line: Int[Tensor, "4 m"]
    slot: Int[Tensor, "s places"]


def _tabulated(moves: _Moves) -> _Table:
    lines, device = moves.lines, moves.line.device
    line = torch.where(moves.line >= 0, moves.line, lines)
    filled = torch.zeros(lines + 2, dtype=torch.int32, device=device)
    filled.scatter_add_(0, line.flatten(), torch.ones_like(line.flatten(), dtype=torch.int32))

    cells = torch.tensor([g * g for g in moves.grids], device=device)[:, None, None]
    slot = (line * cells + (moves.origins()[:, None] + moves.end)[:, None]).flatten(1)
    counted = torch.int16 if len(moves.pair) < 2**15 else torch.int32
    table = _zeros((lines + 1) * sum(g * g for g in moves.grids) + 1, counted, device)
    table.scatter_add_(0, slot.flatten(), torch.ones_like(slot.flatten(), dtype=counted))
    return _Table(table, filled, line, slot)


_scratch = threading.local()  # a table of zeros for each type: to clear its memory is quicker than to have new
_CLEARING = 64  # entries that are cleared one after another in the time of one that is sought out


def _zeros(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A table of zeros, to be given back by `_give_back`."""
    kept: Tensor | None = _scratch.__dict__.pop(f"{dtype} {device}", None)
    return torch.zeros(size, dtype=dtype, device=device) if kept is None or len(kept) < size else kept


def _give_back(table: _Table) -> None:
    """Clear the table for the thread's next one. That of a GPU is too large to keep, and new ones cost little there."""
    if table.moves.device.type != "cpu":
        return
    if table.slot.numel() * _CLEARING < len(table.moves):
        table.moves.index_fill_(0, table.slot.flatten(), 0)
    else:
        table.moves.zero_()
    _scratch.__dict__[f"{table.moves.dtype} cpu"] = table.moves


def _standing(table: _Table, moves: _Moves, turns: int, factor: float) -> UInt8[Tensor, "s m"]:
    """The rotations, as bits, under which a match follows an assignment that stands, for each grid of image 1."""
    line, lines = table.line.flatten(), moves.lines
    occupied = (table.filled[:lines] > 0).nonzero()[:, 0]
    rows = []
    for grid, (side, slot, end) in enumerate(zip(moves.grids, table.slot, moves.end, strict=True)):
        # The cell of image 1 that most matches of a line go to: largest count, then lowest cell.
        merit = table.moves.index_select(0, slot).long() * side**2 + (side**2 - 1 - end).repeat(4)
        best = torch.zeros(lines + 1, dtype=torch.int64, device=line.device).scatter_reduce_(0, line, merit, "amax")
        assigned = side**2 - 1 - best.index_select(0, occupied).remainder(side**2)
        around = _Surroundings(table, moves, grid, occupied, assigned)
        stands = torch.zeros_like(assigned)
        for turn in range(turns):
            score, mean = around.turned(turn)
            stands |= (score >= factor * mean.sqrt()).long() << turn
        verdict = torch.zeros_like(best)  # best cell and, in the low byte, bit k: it stands under rotation k
        verdict.index_copy_(0, occupied, assigned * 256 + stands)
        found = verdict.index_select(0, line).reshape(4, -1)
        bits = torch.where(found >> 8 == end, found, 0).to(torch.uint8)
        rows.append(bits[0] | bits[1] | bits[2] | bits[3])
    return torch.stack(rows)


class _Surroundings:
    """The nine cells around each of C lines in image 0, and those around each of C cells in one grid of image 1."""

    def __init__(
        self, table: _Table, moves: _Moves, grid: int, line: Int[Tensor, " c"], end: Int[Tensor, " c"]
    ) -> None:
        device, side = str(line.device), moves.grids[grid]
        self.table = table
        inside0, step0 = _ring(GRID, device)
        inside1, self.step1 = _ring(side, device)
        self.inside0 = inside0.index_select(1, line.remainder(_CELLS))  # (9, C)
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
    chosen = winner[moves.pair]
    total = torch.zeros(len(chosen), dtype=torch.float64, device=chosen.device)
    for hypothesis in winner.unique().tolist():
        grid, turn = divmod(hypothesis, turns)
        members = (chosen == hypothesis).nonzero()[:, 0]
        for line in moves.line:
            here = members[line[members] >= 0]
            score, mean = _Surroundings(table, moves, grid, line[here], moves.end[grid, here]).turned(turn)
            total.index_add_(0, here, (score - 1).clamp_min(0) / mean.clamp_min(1).sqrt() / 4)
    return total


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
