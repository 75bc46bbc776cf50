"""Scores of models on the matches of one pair, compiled: float32, gains summed as integers.

Models are (m, 9) float32 row by row, of which those of the indices `which` (k,) are scored -> out (k,) float64. points:
(4, n) float32, the rows x0, y0, x1, y1. support: (n,), what each match counts. scale: (n,), one over the square of each
match's threshold. bits: fractional bits that gains are rounded to.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.lanes import added, lanes, sqrt, store, where
from fmtorch.geometry.order_kernels import smallest_but

Array = NDArray[Any]
SINGLES = 16  # float32 numbers of a row
load, fill = lanes(SINGLES)
MATCH = 6  # rows of SINGLES matches
GRID = 12  # cells along each side of each image, of saturated gains
CELL_ROWS = 2 * GRID * GRID // SINGLES
COUNT, TRUNCATED_SQUARES, GEMAN_MCCLURE, TABLE = 0, 1, 2, 3  # gains
ONE, ZERO, TINY = np.float32(1), np.float32(0), np.finfo(np.float32).tiny
REST = np.float32(1 / 26)  # of the gain of Geman & McClure at 5 scales, from which on it is zero
STRETCH = np.float32(1 / (1 - 1 / 26))
BIN_SHIFT, BINS = 21, 1 << 10  # of a float32 the exponent and two bits more


@kernel("f8[:, ::1], f8, b1, f4[:, ::1]", brief=True)
def matches(table: Array, threshold: float, weighted: bool, out: Array) -> None:
    """Points, support and scale -> out (6, n). table: (9, n), of `OnePair`. weighted: by the prior."""
    for i in range(table.shape[1]):
        for r in range(4):
            out[r, i] = table[r, i]
        scale = table[5, i] / threshold
        out[4, i], out[5, i] = table[6, i] if weighted else 1.0, scale * scale


@kernel("f4[:, ::1], i8[::1], f4[:, ::1], f4[::1], f4[::1], i8, f4[::1], i8, f8[::1]")
def score_gains(
    F: Array, which: Array, points: Array, support: Array, scale: Array, gain: int, table: Array, bits: int, out: Array
) -> None:
    """Sums of gains. gain: a code. table: of TABLE, over the squared residual from 0 to the threshold; 0 at its end."""
    matches, shift = _in_rows(points, support, scale), np.float32(1.5 * 2.0 ** (23 - bits))
    gains = np.empty((len(matches) // MATCH, SINGLES), np.float32)
    for k in range(len(which)):
        total = fill(ZERO)
        for row in range(0, len(matches), MATCH):
            g = _squared(F[which[k]], matches, row)
            if gain == COUNT:
                g = where(g <= ONE, fill(ONE), ZERO)
            elif gain == TRUNCATED_SQUARES:
                g = ONE - g
            elif gain == GEMAN_MCCLURE:
                g = _geman_mcclure(g)
            store(gains, row // MATCH, g)
        if gain == TABLE:
            _looked_up(gains.ravel(), table)
        for row in range(len(gains)):
            total += _rounded(load(gains, row) * load(matches, MATCH * row + 5), shift)
        out[k] = added(total)


@inner
def _looked_up(r2: Array, table: Array) -> None:
    """The entries of a table at squared residuals, in place."""
    last = np.float32(len(table) - 1)
    for i in range(len(r2)):
        entry = r2[i] * last
        r2[i] = table[np.int32(entry if entry < last else last)]


@kernel("f4[:, ::1], i8[::1], f4[:, ::1], f4[::1], f4[::1], i4[:, ::1], i8, f8[::1]")
def score_saturated(
    F: Array, which: Array, points: Array, support: Array, scale: Array, cells: Array, bits: int, out: Array
) -> None:  # fmt: skip
    """Sums over the cells of both images of roots of summed gains of Geman & McClure. cells: of `saturated_cells`."""
    matches, shift = _in_rows(points, support, scale), np.float32(1.5 * 2.0 ** (23 - bits))
    gains, sums = np.empty((len(matches) // MATCH, SINGLES), np.float32), np.empty((CELL_ROWS, SINGLES), np.float32)
    for k in range(len(which)):
        for row in range(0, len(matches), MATCH):
            g = _geman_mcclure(_squared(F[which[k]], matches, row))
            store(gains, row // MATCH, _rounded(g * load(matches, row + 5), shift))
        for row in range(CELL_ROWS):
            store(sums, row, fill(ZERO))
        gain, of_cell = gains.ravel(), sums.ravel()
        for i in range(points.shape[1]):
            of_cell[cells[0, i]] += gain[i]
            of_cell[cells[1, i]] += gain[i]
        total = fill(ZERO)
        for row in range(CELL_ROWS):
            total += _rounded(sqrt(load(sums, row)), shift)
        out[k] = added(total)


@kernel("f4[:, ::1], f4[::1], i4[:, ::1]", brief=True)
def saturated_cells(points: Array, support: Array, out: Array) -> None:
    """Each match's cells in grids over the matches of support -> out (2, n), of image 0 and, counted on, of image 1."""
    for image in range(2):
        out[image] = image * GRID * GRID
        for axis in range(2):
            x, low, high = points[2 * image + axis], np.float32(math.inf), np.float32(-math.inf)
            for i in range(len(x)):
                if support[i] > ZERO:
                    low, high = min(low, x[i]), max(high, x[i])
            for i in range(len(x)):
                share = (x[i] - low) / max(high - low, TINY) * np.float32(GRID)
                cell = np.int32(min(max(share, ZERO), np.float32(GRID - 1))) if math.isfinite(share) else np.int32(0)
                out[image, i] += cell * (GRID if axis else 1)


@kernel("f4[:, ::1], i8[::1], f4[:, ::1], f8[::1]")
def score_median(F: Array, which: Array, points: Array, out: Array) -> None:
    """Minus the median squared residual, of an even number the lower middle one."""
    n = points.shape[1]
    matches, some = _in_rows(points, np.ones(n, np.float32), np.ones(n, np.float32)), np.empty(n + 1, np.float32)
    r2, counts = np.empty((len(matches) // MATCH, SINGLES), np.float32), np.empty(BINS, np.int32)
    for k in range(len(which)):
        for row in range(0, len(matches), MATCH):
            store(r2, row // MATCH, _squared(F[which[k]], matches, row))
        out[k] = -_smallest(r2.ravel()[:n], counts, some, (n + 1) // 2)


@inner
def _in_rows(points: Array, support: Array, scale: Array) -> Array:
    """Matches (n,), SINGLES in MATCH rows each: points, scale, support; those that fill the last ones have none."""
    n = len(support)
    rows = np.zeros(((n + SINGLES - 1) // SINGLES * MATCH, SINGLES), np.float32)
    for first in range(0, n, SINGLES):
        row = first // SINGLES * MATCH
        for i in range(min(SINGLES, n - first)):
            for k in range(4):
                rows[row + k, i] = points[k, first + i]
            rows[row + 4, i], rows[row + 5, i] = scale[first + i], support[first + i]
    return rows


@inner
def _squared(f: Array, matches: Array, row: int) -> Any:
    """Squared Sampson distances of SINGLES matches, times their scale."""
    x0, y0, x1, y1 = load(matches, row), load(matches, row + 1), load(matches, row + 2), load(matches, row + 3)
    a0, b0 = f[0] * x0 + f[1] * y0 + f[2], f[3] * x0 + f[4] * y0 + f[5]
    e = f[6] * x0 + f[7] * y0 + f[8] + a0 * x1 + b0 * y1
    a1, b1 = f[0] * x1 + f[3] * y1 + f[6], f[1] * x1 + f[4] * y1 + f[7]
    slope = a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1
    return e * e / where(slope > TINY, slope, TINY) * load(matches, row + 4)


@inner
def _geman_mcclure(r2: Any) -> Any:
    """The gain of Geman & McClure of squared residuals."""
    g = ONE / (r2 + ONE) - REST
    return where(g > ZERO, g, ZERO) * STRETCH


@inner
def _rounded(gain: Any, shift: Any) -> Any:
    """Gains rounded to even multiples of what the shift, 1.5 2^(23 - bits), allows; what is not a number is zero."""
    return where(gain > ZERO, gain, ZERO) + shift - shift


@inner
def _smallest(values: Array, counts: Array, some: Array, rank: int) -> Any:
    """The value of a rank, from 1, in ascending order, of numbers that are not negative; NaN counts as infinite.

    counts: (BINS,), some: (n + 1,), for the work. First the bin of the value is found, by its upper bits.
    """
    for i in range(len(values)):
        values[i] = values[i] if values[i] == values[i] else np.float32(math.inf)
    bits = values.view(np.int32)
    for b in range(BINS):
        counts[b] = 0
    for i in range(len(values)):
        counts[bits[i] >> BIN_SHIFT] += 1
    wanted, left = 0, rank
    while counts[wanted] < left:
        left -= counts[wanted]
        wanted += 1
    m = 0
    for i in range(len(values)):
        some[m] = values[i]
        m += (bits[i] >> BIN_SHIFT) == wanted
    return smallest_but(some, 0, m, left - 1)
