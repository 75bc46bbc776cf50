"""Grid-based motion statistics: GMS (Bian et al., CVPR 2017)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from fmtorch.compiling.batches import for_each_pair, kernels_serve
from fmtorch.core.records import ungraphed
from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.pruning import gms_kernels as compiled
from fmtorch.pruning.calibration import calibration_of
from fmtorch.pruning.gms_table import GRIDS, Border, Moves, Surroundings, Table, give_back, moves_in_blocks, tabulated


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
        return for_each_pair(compiled.gms, tensors, *options, out=out, kind=torch.float64, group=compiled.Matches)
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
        for_each_pair(compiled.gms_support, tensors, *options, out=out, kind=torch.float64, group=compiled.Matches)
        return out.to(x0.dtype)
    support = torch.zeros(x0.shape[:2], dtype=x0.dtype, device=x0.device)
    for moves, place in moves_in_blocks(x0, x1, size0, size1, mask, grids, border):
        table = tabulated(moves)
        winner = torch.zeros(moves.pairs, dtype=torch.int64, device=x0.device)
        if len(grids) * turns > 1:
            winner = _winner(_standing(table, moves, turns, threshold_factor), moves, turns)
        z = _own_support(table, moves, winner, turns)
        give_back(table)
        support.view(-1)[place] = (z / (z + compiled.HALF_SUPPORT)).to(support.dtype)
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
