"""Grid-based motion statistics (Bian et al., CVPR 2017), one cell at a time, for one pair."""

import math
from collections import Counter

import numpy as np

GRID = 20
SCALES = (1.0, 1 / 2, 1 / math.sqrt(2), math.sqrt(2), 2.0)
SHIFTS = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5))
RING = ((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0))  # (x, y), clockwise from the top left


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


def run(p0: np.ndarray, p1: np.ndarray, scale: float, turn: int, factor: float, authors: bool) -> np.ndarray:
    """The mask for one scale and one rotation (in steps of 45 degrees)."""
    kept = np.zeros(len(p0), bool)
    grid1 = int(GRID * scale)
    for shift in SHIFTS:
        left = [cell(p, GRID, shift, authors) for p in p0]
        right = [cell(p, grid1, (0.0, 0.0), False) for p in p1]
        both = [(a, b) for a, b in zip(left, right, strict=True) if a is not None and b is not None]
        moves, filled = Counter(both), Counter(a for a, _ in both)
        partner = {}
        for a in filled:
            counts = {b: n for (start, b), n in moves.items() if start == a}
            best = min(counts, key=lambda b: (-counts[b], b[1] * grid1 + b[0]))
            score, total, pairs = 0, 0, 0
            for j, (dx, dy) in enumerate((*RING, (0, 0))):
                ex, ey = RING[(j - turn) % 8] if j < 8 else (0, 0)
                na, nb = (a[0] + dx, a[1] + dy), (best[0] + ex, best[1] + ey)
                if min(*na, *nb) < 0 or max(na) >= GRID or max(nb) >= grid1:
                    continue
                score, total, pairs = score + moves[na, nb], total + filled[na], pairs + 1
            if score >= factor * math.sqrt(total / pairs):
                partner[a] = best
        for i, (start, end) in enumerate(zip(left, right, strict=True)):
            if start is not None and end is not None and partner.get(start) == end:
                kept[i] = True
    return kept


def gms(
    x0: np.ndarray,
    x1: np.ndarray,
    size0: tuple[int, int],
    size1: tuple[int, int],
    with_rotation: bool,
    with_scale: bool,
    factor: float,
    authors: bool,
) -> np.ndarray:
    """The mask with most matches over the hypotheses, the first of equals."""
    p0, p1 = normalised(x0, size0), normalised(x1, size1)
    best = np.zeros(len(x0), bool)
    for scale in SCALES if with_scale else SCALES[:1]:
        for turn in range(8 if with_rotation else 1):
            kept = run(p0, p1, scale, turn, factor, authors)
            if kept.sum() > best.sum():
                best = kept
    return best


def support(
    x0: np.ndarray, x1: np.ndarray, size0: tuple[int, int], size1: tuple[int, int], scale: float, turn: int
) -> list[float]:
    """The mean over the shifted grids of (score - 1) / sqrt(mean, at least 1) at each match's own cells."""
    p0, p1 = normalised(x0, size0), normalised(x1, size1)
    grid1 = int(GRID * scale)
    total = [0.0] * len(x0)
    for shift in SHIFTS:
        left = [cell(p, GRID, shift, False) for p in p0]
        right = [cell(p, grid1, (0.0, 0.0), False) for p in p1]
        both = [(a, b) for a, b in zip(left, right, strict=True) if a is not None and b is not None]
        moves, filled = Counter(both), Counter(a for a, _ in both)
        for i, (a, b) in enumerate(zip(left, right, strict=True)):
            if a is None or b is None:
                continue
            score, count, pairs = 0, 0, 0
            for j, (dx, dy) in enumerate((*RING, (0, 0))):
                ex, ey = RING[(j - turn) % 8] if j < 8 else (0, 0)
                na, nb = (a[0] + dx, a[1] + dy), (b[0] + ex, b[1] + ey)
                if min(*na, *nb) >= 0 and max(na) < GRID and max(nb) < grid1:
                    score, count, pairs = score + moves[na, nb], count + filled[na], pairs + 1
            total[i] += (score - 1) / math.sqrt(max(count / pairs, 1)) / 4
    return total
