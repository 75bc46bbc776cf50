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

from fmtorch.geometry.order_kernels import smallest_but
from fmtorch.kernels import inner, kernel

Array = NDArray[Any]
GRID = 12  # cells along each side of each image, of saturated gains
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
    n = points.shape[1]
    r2, gains = np.empty(n, np.float32), np.empty(n, np.int32)
    for k in range(len(which)):
        _squared(F[which[k]], points, scale, r2)
        if gain == COUNT:
            for i in range(n):
                r2[i] = ONE if r2[i] <= ONE else ZERO
        elif gain == TRUNCATED_SQUARES:
            for i in range(n):
                g = ONE - r2[i]
                r2[i] = g if g > ZERO else ZERO
        elif gain == GEMAN_MCCLURE:
            _geman_mcclure(r2)
        else:
            last = np.float32(len(table) - 1)
            for i in range(n):
                entry = r2[i] * last
                r2[i] = table[np.int32(entry if entry < last else last)]
        _rounded(r2, support, bits, gains)
        total = np.int32(0)
        for i in range(n):
            total += gains[i]
        out[k] = total * 2.0**-bits


@kernel("f4[:, ::1], i8[::1], f4[:, ::1], f4[::1], f4[::1], i4[:, ::1], i8, f8[::1]")
def score_saturated(
    F: Array, which: Array, points: Array, support: Array, scale: Array, cells: Array, bits: int, out: Array
) -> None:  # fmt: skip
    """Sums over the cells of both images of roots of summed gains of Geman & McClure. cells: of `saturated_cells`."""
    n = points.shape[1]
    r2, gains = np.empty(n, np.float32), np.empty(n, np.int32)
    sums, roots = np.empty(2 * GRID * GRID, np.int32), np.empty(2 * GRID * GRID, np.float32)
    whole, rounded = np.ones(2 * GRID * GRID, np.float32), np.empty(2 * GRID * GRID, np.int32)
    unit = np.float32(2.0**-bits)
    for k in range(len(which)):
        _squared(F[which[k]], points, scale, r2)
        _geman_mcclure(r2)
        _rounded(r2, support, bits, gains)
        for c in range(len(sums)):
            sums[c] = 0
        for i in range(n):
            sums[cells[0, i]] += gains[i]
            sums[cells[1, i]] += gains[i]
        for c in range(len(sums)):
            roots[c] = math.sqrt(np.float32(sums[c]) * unit)
        _rounded(roots, whole, bits, rounded)
        total = np.int32(0)
        for c in range(len(sums)):
            total += rounded[c]
        out[k] = total * 2.0**-bits


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
    r2, scale, some = np.empty(n, np.float32), np.ones(n, np.float32), np.empty(n + 1, np.float32)
    counts = np.empty(BINS, np.int32)
    for k in range(len(which)):
        _squared(F[which[k]], points, scale, r2)
        out[k] = -_smallest(r2, counts, some, (n + 1) // 2)


@inner
def _squared(f: Array, points: Array, scale: Array, r2: Array) -> None:
    """Squared Sampson distances of all matches, times their scale -> r2 (n,)."""
    x0, y0, x1, y1 = points[0], points[1], points[2], points[3]
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    for i in range(len(r2)):
        a0, b0 = f0 * x0[i] + f1 * y0[i] + f2, f3 * x0[i] + f4 * y0[i] + f5
        e = f6 * x0[i] + f7 * y0[i] + f8 + a0 * x1[i] + b0 * y1[i]
        a1, b1 = f0 * x1[i] + f3 * y1[i] + f6, f1 * x1[i] + f4 * y1[i] + f7
        slope = a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1
        r2[i] = e * e / (slope if slope > TINY else TINY) * scale[i]


@inner
def _geman_mcclure(r2: Array) -> None:
    """The gain of Geman & McClure of squared residuals, in place."""
    for i in range(len(r2)):
        g = ONE / (r2[i] + ONE) - REST
        r2[i] = (g if g > ZERO else ZERO) * STRETCH


@inner
def _rounded(gain: Array, support: Array, bits: int, out: Array) -> None:
    """Gains times support in units of 2^-bits, rounded to even -> out (n,) int32; what is not a number is zero."""
    shift, unit = np.float32(1.5 * 2.0 ** (23 - bits)), np.float32(2.0**bits)
    for i in range(len(out)):
        g = gain[i] * support[i]
        g = g if g > ZERO else ZERO
        out[i] = np.int32((g + shift - shift) * unit)


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
