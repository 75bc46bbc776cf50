"""Filters by what is known of each match, its ratio, mutuality or location, and by how its neighbours move: GMS."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.core import Correspondences, Within
from fmtorch.core.checks import box_of, expect_inside
from fmtorch.geometry.significance import Matches
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, I8x1, for_each_pair, inner, kernel, vector
from fmtorch.jit.random import mix
from fmtorch.pruning.calibration import calibration_of

Points = Float[Tensor, "b n 2"]


def ratio_test(
    ratio: Float[Tensor, "b n"], threshold: float = 0.8, mask: Bool[Tensor, "b n"] | None = None
) -> Bool[Tensor, "b n"]:
    """True where the ratio of the distances to the nearest and second nearest descriptor is below `threshold`.
    The ratio is of Euclidean, not squared, distances; a ratio that is NaN fails. Lowe, IJCV 2004, section 7.1."""
    kept = ratio < threshold
    return kept if mask is None else kept & mask


@dataclasses.dataclass(frozen=True)
class RatioTest:
    """`ratio_test` of the ratios, or of 1 - score, as a stage. Raises ValueError where matches have neither."""

    threshold: Annotated[float, Within(0)] = 0.8

    def __call__(self, c: Correspondences) -> Correspondences:
        if c.ambiguity is None:
            said = "the nearest-neighbour distance ratio of each match"
            raise ValueError(f"the ratio test needs `ratio`, {said}, or `score`")
        return c.keep(ratio_test(c.ambiguity, self.threshold))


class MutualCheck:
    """Matches survive that are the best ones of both features. Raises ValueError where the matcher did not tell."""

    def __call__(self, c: Correspondences) -> Correspondences:
        if c.mutual is None:
            raise ValueError("the mutual check needs `mutual`, which a matcher of both directions supplies")
        return c.keep(c.mutual)


def one_to_one(
    x0: Points, x1: Points, ambiguity: Float[Tensor, "b n"], mask: Bool[Tensor, "b n"] | None = None
) -> Bool[Tensor, "b n"]:
    """True for a match that is the best one at its location in image 0 and the best one at its location in image 1.
    The best has the lowest `ambiguity` (NaN is worst), ties by lowest index. Locations are the same when coordinates
    are exactly equal, as those of one keypoint with several orientations are. The rule is symmetric in the images and
    independent of the order of the matches, ties apart. Matches with a non-finite coordinate are dropped. O(N)."""
    mask = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    out = torch.empty(mask.shape, dtype=torch.bool)
    return for_each_pair(one_to_one_kernel, (x0, x1, ambiguity, mask), out=out, kind=torch.float64)


@kernel
def one_to_one_kernel(x0: F8x2, x1: F8x2, ambiguity: F8x1, mask: B1x1, out: B1x1) -> None:
    """`one_to_one` of x0, x1 (n, 2), ambiguity, mask (n,) -> out (n,)."""
    n = len(mask)
    valid, rank = np.empty(n, np.bool_), vector(n)
    for i in range(n):
        finite = math.isfinite(x0[i, 0]) and math.isfinite(x0[i, 1])
        valid[i] = mask[i] and finite and math.isfinite(x1[i, 0]) and math.isfinite(x1[i, 1])
        rank[i] = math.inf if math.isnan(ambiguity[i]) else ambiguity[i]
        out[i] = valid[i]
    _drop_all_but_the_best(x0, rank, valid, out)
    _drop_all_but_the_best(x1, rank, valid, out)


@inner
def _drop_all_but_the_best(x: Array, rank: Array, valid: Array, out: Array) -> None:
    """Sets out[i] to False where another valid match at the same location has a lower (rank, index): a hash table."""
    n = len(valid)
    size = 4
    while size < 2 * n:
        size *= 2
    place, best = np.empty(n, np.int64), np.full(size, -1, np.int64)
    at = x + 0.0  # -0 becomes 0
    bits = at.view(np.uint64)
    for i in range(n):
        if not valid[i]:
            continue
        slot = np.int64(mix(bits[i, 0] + np.uint64(0x9E3779B97F4A7C15) * mix(bits[i, 1])) & np.uint64(size - 1))
        while best[slot] >= 0 and (at[best[slot], 0] != at[i, 0] or at[best[slot], 1] != at[i, 1]):
            slot = (slot + 1) & (size - 1)
        place[i] = slot
        if best[slot] < 0 or rank[i] < rank[best[slot]]:
            best[slot] = i
    for i in range(n):
        if valid[i] and best[place[i]] != i:
            out[i] = False


@dataclasses.dataclass(frozen=True)
class OneToOne:
    """`one_to_one` as a stage. Raises ValueError for correspondences with neither `ratio` nor `score`."""

    def __call__(self, c: Correspondences) -> Correspondences:
        if c.ambiguity is None:
            raise ValueError("one-to-one needs `ratio` or `score`, by which the best match of a location is chosen")
        return c.keep(one_to_one(c.x0, c.x1, c.ambiguity, c.mask))


# Grid-based motion statistics: GMS (Bian et al., CVPR 2017)

GRID = 20  # cells a side in image 0
CELLS = GRID * GRID
HALF_SUPPORT = 1.5  # the score, in square roots of the mean, whose support is one half
# The cells around a cell as (dx, dy), clockwise from the top left. A rotation by 45 degrees moves the ring on by one.
RING = np.array(((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0)))


@kernel
def gms_kernel(matches: Matches, sides: I8x1, turns: int, factor: float, authors: bool, out: B1x1) -> None:
    """`gms` of n matches -> out (n,).
    sides: cells a side of the grids in image 1. authors: whose rule at the border holds."""
    match, p0, p1 = _inside(matches)
    bits, winner = _standing(p0, p1, sides, turns, factor, authors)
    out[:] = False
    for i in range(len(match)):
        out[match[i]] = (bits[winner // turns, i] >> (winner % turns)) & 1


@kernel
def gms_support_kernel(matches: Matches, sides: I8x1, turns: int, factor: float, authors: bool, out: F8x1) -> None:
    """`gms_support` of n matches -> out (n,); arguments as `gms`."""
    match, p0, p1 = _inside(matches)
    out[:] = 0
    m, winner = len(match), 0
    if len(sides) * turns > 1:
        _, winner = _standing(p0, p1, sides, turns, factor, authors)
    side, turn = sides[winner // turns], winner % turns
    end, line, filled, z = _ends(p1, side), np.empty(m, np.int64), np.empty(CELLS, np.int64), np.zeros(m)
    table = np.zeros(CELLS * side * side, np.int32)  # the matches from each cell of image 0 to each of image 1
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
    x0, x1, mask, size0, size1 = matches
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
    end = np.empty(len(p1), np.int64)
    for i in range(len(p1)):
        end[i] = np.int64(p1[i, 1] * np.float32(side)) * side + np.int64(p1[i, 0] * np.float32(side))
    return end


@inner
def _count(
    p0: Array, end: Array, shift: int, side: int, authors: bool, line: Array, table: Array, filled: Array
) -> None:  # fmt: skip
    """The cells of image 0 in a shifted grid -> line (m,), -1 for none; and the matches that go where, and from where.
    shift: 1 along x, 2 along y, 3 along both."""
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
def _standing(p0: Array, p1: Array, sides: Array, turns: int, factor: float, authors: bool) -> tuple[Array, int]:
    """The rotations, as bits, under which each match follows an assignment that stands, (grids, m), and the
    hypothesis, grid * turns + turn, that keeps most matches, the first of equals."""
    m, largest = len(p0), 0
    for side in sides:
        largest = max(largest, side)
    bits, table = np.zeros((len(sides), m), np.uint8), np.zeros(CELLS * largest * largest, np.int32)
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


Border = Literal["opencv", "authors"]
Options = tuple[bool, bool, float, Border]  # with_rotation, with_scale, threshold_factor, border
# Cells a side in image 1 at the scale ratios 1, 1/2, 1/sqrt(2), sqrt(2), 2, rounded down as the released code does.
GRIDS = (20, 10, 14, 28, 40)


def gms(
    x0: Points, x1: Points,
    *, size0: Int[Tensor, "b 2"], size1: Int[Tensor, "b 2"], mask: Bool[Tensor, "b n"] | None = None,
    with_rotation: bool = False, with_scale: bool = False, threshold_factor: float = 6.0, border: Border = "opencv",
) -> Bool[Tensor, "b n"]:  # fmt: skip
    """True for matches whose neighbours move with them, as counted on coarse grids.

    Each of four shifted 20 x 20 grids in image 0 assigns every cell the cell of image 1 that most of its matches go
    to; the assignment stands when the nine cells around move likewise often enough,
    ``score >= threshold_factor * sqrt(mean matches of the nine cells)``. A match is kept when it
    follows the assignment of its cell in one of the grids. with_rotation tries eight rotations of the neighbourhood,
    with_scale five sizes of the grid in image 1; the hypothesis that keeps most matches wins, the first of equals.

    x0, x1 in pixels, size0, size1 as (h, w). Matches outside their images' grids are dropped. Masks equal those of
    OpenCV's matchGMS; border="authors" gives those of the authors' code, which drops points in the left and top half
    cells of shifted grids. Time and memory are linear in the number of matches, besides a table of cell pairs. Computed
    on the CPU. Raises ValueError for sizes that contradict the points of all pairs, such as (w, h)."""
    options = with_rotation, with_scale, threshold_factor, border
    return _of_each_pair(gms_kernel, torch.bool, (x0, x1), (size0, size1), mask, options)


def gms_support(
    x0: Points, x1: Points,
    *, size0: Int[Tensor, "b 2"], size1: Int[Tensor, "b 2"], mask: Bool[Tensor, "b n"] | None = None,
    with_rotation: bool = False, with_scale: bool = False, threshold_factor: float = 6.0, border: Border = "opencv",
) -> Float[Tensor, "b n"]:  # fmt: skip
    """How many neighbours move with each match, against how many would suffice by the square root; in [0, 1).
    In each of the four grids, ``z = (score - 1) / sqrt(mean matches of the nine cells, at least 1)``, where the score
    counts the matches, itself included, of the nine cells around that go where the match's own cells say: the paper's
    S_i for each match instead of for the assignment of its cell. The support is ``z / (z + 1.5)`` of the mean z over
    the grids; 0 for a match that is alone, outside or masked. Rotation and scale are those of the hypothesis that keeps
    most matches of the pair in `gms`, whose arguments these are."""
    options = with_rotation, with_scale, threshold_factor, border
    return _of_each_pair(gms_support_kernel, torch.float64, (x0, x1), (size0, size1), mask, options).to(x0)


def _of_each_pair(
    of_pair: Any, kind: torch.dtype, x: Sequence[Tensor], sizes: Sequence[Tensor], mask: Tensor | None, options: Options
) -> Tensor:
    """What a kernel makes of the matches of each pair, numbers of a kind."""
    with_rotation, with_scale, threshold_factor, border = options
    mask = torch.ones_like(x[0][..., 0], dtype=torch.bool) if mask is None else mask
    for i, size in enumerate(sizes):
        expect_inside(x[i], box_of(x[i], mask), size, f"x{i}", f"size{i}")
    tensors, out = (*x, mask, sizes[0].float(), sizes[1].float()), torch.empty(mask.shape, dtype=kind)
    sides = np.array(GRIDS if with_scale else GRIDS[:1])
    same = sides, 8 if with_rotation else 1, threshold_factor, border == "authors"
    return for_each_pair(of_pair, tensors, *same, out=out, kind=torch.float64, group=Matches)


class GMS:
    """`gms` as a stage; or, `soft`, a stage that keeps every match and supplies ``prior``: P(inlier) by `gms_support`.
    calibration: of the support, see `Calibration`; needed by the soft form alone. The other options are those of `gms`.
    Raises ValueError for the soft form without a calibration, and for correspondences without image sizes."""

    def __init__(
        self, *, with_rotation: bool = False, with_scale: bool = False, threshold_factor: float = 6.0,
        border: Border = "opencv", soft: bool = False, calibration: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:  # fmt: skip
        self._options: dict[str, Any] = {"with_rotation": with_rotation, "with_scale": with_scale, "border": border}
        self._options["threshold_factor"] = threshold_factor
        self.calibration = calibration_of("GMS", soft, calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only those survive that move with their neighbours, or with a prior."""
        return self.calibration(c, self.evidence(c)) if self.calibration else c.keep(gms(**self._arguments(c)))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from: `gms_support`."""
        return gms_support(**self._arguments(c))

    def _arguments(self, c: Correspondences) -> dict[str, Any]:
        if c.size0 is None or c.size1 is None:
            raise ValueError("GMS needs `size0` and `size1`: its grids divide the images")
        return {"x0": c.x0, "x1": c.x1, "size0": c.size0, "size1": c.size1, "mask": c.mask, **self._options}
