"""Grid-based motion statistics (Bian et al., CVPR 2017), one cell at a time, for one pair."""

import itertools
import math
from collections import Counter

import numpy as np

GRID = 20
SCALES = (1.0, 1 / 2, 1 / math.sqrt(2), math.sqrt(2), 2.0)
SHIFTS = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5))
RING = ((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0))  # (x, y), clockwise from the top left
Sizes = tuple[tuple[int, int], tuple[int, int]]


def normalised(x: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return x.astype(np.float32) / np.array([size[1], size[0]], np.float32)


def cell(point: np.ndarray, grid: int, shift: tuple[float, float], drop_half_cells: bool) -> tuple[int, int] | None:
    """Column and row of a point, or None where it is in no cell, as points outside the image are."""
    if not (point >= 0).all() or not (point < 1).all():
        return None
    place = []
    for value, offset in zip(point, shift, strict=True):
        index = math.floor(float(np.float32(value) * np.float32(grid)) + offset)
        if not (1 if drop_half_cells and offset else 0) <= index < grid:
            return None
        place.append(index)
    return place[0], place[1]


class Motion:
    """The cells of all matches for one scale and one shift of the first grid, and the counts of matches in them."""

    def __init__(self, p0: np.ndarray, p1: np.ndarray, scale: float, shift: tuple[float, float], authors: bool) -> None:
        self.side = int(GRID * scale)  # of the second grid
        left = [cell(p, GRID, shift, authors) for p in p0]
        right = [cell(p, self.side, (0.0, 0.0), False) for p in p1]
        self.cells = {i: (a, b) for i, (a, b) in enumerate(zip(left, right, strict=True)) if a and b}
        self.moves, self.filled = Counter(self.cells.values()), Counter(a for a, _ in self.cells.values())

    def support(self, a: tuple[int, int], b: tuple[int, int], turn: int) -> tuple[int, float]:
        """The matches that move from the cells around a to those around b, turned; the mean number in the former."""
        score, total, pairs = 0, 0, 0
        for j, (dx, dy) in enumerate((*RING, (0, 0))):
            ex, ey = RING[(j - turn) % 8] if j < 8 else (0, 0)
            na, nb = (a[0] + dx, a[1] + dy), (b[0] + ex, b[1] + ey)
            if min(*na, *nb) >= 0 and max(na) < GRID and max(nb) < self.side:
                score, total, pairs = score + self.moves[na, nb], total + self.filled[na], pairs + 1
        return score, total / pairs


def run(p0: np.ndarray, p1: np.ndarray, scale: float, turn: int, factor: float, authors: bool) -> np.ndarray:
    """The mask for one scale and one rotation (in steps of 45 degrees)."""
    kept = np.zeros(len(p0), bool)
    for shift in SHIFTS:
        motion = Motion(p0, p1, scale, shift, authors)
        partner = {}
        for a in motion.filled:
            counts = {b: n for (start, b), n in motion.moves.items() if start == a}
            best = min(counts, key=lambda b: (-counts[b], b[1] * motion.side + b[0]))
            score, mean = motion.support(a, best, turn)
            if score >= factor * math.sqrt(mean):
                partner[a] = best
        for i, (start, end) in motion.cells.items():
            kept[i] |= partner.get(start) == end
    return kept


def hypotheses(searched: bool) -> list[tuple[float, int]]:
    return list(itertools.product(SCALES, range(8))) if searched else [(1.0, 0)]


def gms(x0: np.ndarray, x1: np.ndarray, sizes: Sizes, searched: bool, factor: float, authors: bool) -> np.ndarray:
    """The mask with most matches over the hypotheses, the first of equals; searched: over turns and scales."""
    p0, p1 = normalised(x0, sizes[0]), normalised(x1, sizes[1])
    masks = [run(p0, p1, scale, turn, factor, authors) for scale, turn in hypotheses(searched)]
    return max(masks, key=lambda kept: int(kept.sum()))


def support(x0: np.ndarray, x1: np.ndarray, sizes: Sizes, searched: bool, factor: float) -> list[float]:
    """The mean over the shifted grids of (score - 1) / sqrt(mean, at least 1) at each match's own cells, for the
    hypothesis whose mask has most matches."""
    p0, p1 = normalised(x0, sizes[0]), normalised(x1, sizes[1])
    scale, turn = max(hypotheses(searched), key=lambda h: int(run(p0, p1, h[0], h[1], factor, False).sum()))
    total = [0.0] * len(x0)
    for shift in SHIFTS:
        motion = Motion(p0, p1, scale, shift, False)
        for i, (a, b) in motion.cells.items():
            score, mean = motion.support(a, b, turn)
            total[i] += (score - 1) / math.sqrt(max(mean, 1)) / 4
    return total
