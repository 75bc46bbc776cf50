"""Octaves of noise: a grid of random numbers enlarged by cubic interpolation, in two forms with the same bits."""

from __future__ import annotations

import functools

import cv2
import numpy as np

from fmtorch.compiling import switch
from fmtorch.data.rendered.mipmap import Floats
from fmtorch.data.rendered.noise_kernels import Neighbours, add_enlarged

BORDER = 2  # grid points beyond each side
_COMPILED_FROM = 8  # times enlarged; below, little is computed that is not used, and cv2 rounds otherwise at the sides
_PERIOD = 8  # of the comb by which the weights of neighbours are told apart


def add_octave(total: Floats, grid: Floats, weight: float) -> None:
    """Adds `weight` x a grid (rows + 4, columns + 4), whose inner part is enlarged to the size of `total`."""
    rows, cols = (side - 2 * BORDER for side in grid.shape)
    if switch.available() and min(total.shape[0] / rows, total.shape[1] / cols) >= _COMPILED_FROM and _same_bits():
        if not _add_compiled(total, grid, weight):
            _add(total, grid, weight)
    else:
        _add(total, grid, weight)


def _add(total: Floats, grid: Floats, weight: float) -> None:
    h, w = total.shape
    (tall, y), (wide, x) = _place(h, grid.shape[0]), _place(w, grid.shape[1])
    big = cv2.resize(grid, (wide, tall), interpolation=cv2.INTER_CUBIC)
    part = big[y : y + h, x : x + w].astype(np.float32)
    part = cv2.resize(part, (w, h)).astype(np.float32) if part.shape != (h, w) else part
    total += np.float32(weight) * part


def _add_compiled(total: Floats, grid: Floats, weight: float) -> bool:
    """As `_add`, with the same results; False, and nothing is added, where the enlarged grid is too small."""
    rows, columns = _neighbours(total.shape[0], grid.shape[0]), _neighbours(total.shape[1], grid.shape[1])
    if rows is None or columns is None:
        return False
    add_enlarged(np.ascontiguousarray(grid), columns, rows, np.float32(weight), total)
    return True


def _place(side: int, points: int) -> tuple[int, int]:
    """The side of the whole grid of so many points when its inner part has `side` pixels, and where that begins."""
    inner = points - 2 * BORDER
    return round(side / inner * points), round(BORDER * side / inner)


def _neighbours(side: int, points: int) -> Neighbours | None:
    """The neighbours of the pixels of a side; None if the pixels or their neighbours are not all there.

    The weights are those of `cv2.resize`, which enlarges combs: points of one and of zero.
    """
    whole, begin = _place(side, points)
    comb = (np.arange(points) % _PERIOD == np.arange(_PERIOD)[:, None]).astype(np.float32)
    kernel_weights = cv2.resize(comb, (whole, _PERIOD), interpolation=cv2.INTER_CUBIC)[:, begin : begin + side]
    pixel = np.arange(begin, begin + side)
    first = np.floor((pixel + 0.5) * (points / whole) - 0.5).astype(np.int64) - 1
    if kernel_weights.shape[1] < side or first.min() < 0 or first.max() + 4 > points:
        return None
    weights = kernel_weights[(first + np.arange(_PERIOD)[:, None]) % _PERIOD, pixel - begin]
    return Neighbours(first, np.ascontiguousarray(weights[:4])) if not weights[4:].any() else None


@functools.cache
def _same_bits() -> bool:
    """Whether both forms round alike on this processor; without Intel's library, or with another, they may not."""
    grid = np.random.default_rng(0).standard_normal((9, 13), dtype=np.float32)
    expected, compiled = np.zeros((2, 83, 151), dtype=np.float32)
    _add(expected, grid, 1.0)
    return _add_compiled(compiled, grid, 1.0) and bool((expected == compiled).all())
