"""The door of one pair and the way back to its pixels, compiled: as `pairs` and `geometry.pixel_frame`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import inner, kernel

Array = NDArray[Any]


@kernel(
    "f8[:, ::1], f8[:, ::1], b1[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], i8[::1], f8[::1], f8[::1]",
    brief=True,
)
def normalize(
    x0: Array, x1: Array, mask: Array, prior: Array, noise: Array, quality: Array, sizes: Array, bounds: Array,
    slot: Array, table: Array, frame: Array,
) -> int:  # fmt: skip
    """Where the usable ones of n matches stand -> slot (m,); what is known of them -> the first 9 m of table; m.

    x0, x1: (n, 2), pixels. prior, noise, quality: (n,), sizes: (4,), sides of the images; empty where unknown. bounds:
    (3,), what coordinates are below, the least noise and the greatest. table: (9 n,), the rows of `OnePair` one after
    the other. frame: (6,), the middle of the box around the points of each image; the unit in pixels, 0 where all
    coincide; and 1 where all priors, noises and sizes are right, otherwise 0.
    """
    count, half, most, right = 0, 0.0, bounds[0], True
    for i in range(len(mask)):
        if mask[i] and abs(x0[i, 0]) < most and abs(x0[i, 1]) < most and abs(x1[i, 0]) < most and abs(x1[i, 1]) < most:
            slot[count] = i
            count += 1
    for r in range(4):
        x, low, high = x0 if r < 2 else x1, math.inf, -math.inf
        for i in range(count):
            value = x[slot[i], r % 2]
            table[r * count + i] = value
            low, high = min(low, value), max(high, value)
        frame[r], half = (low + high) / 2, max(half, (high - low) / 2)
    unit = power_of_two(half) if half > 0 else 0.0
    for r in range(4 if half > 0 else 0):
        for i in range(r * count, (r + 1) * count):
            table[i] = (table[i] - frame[r]) / unit
    for i in range(count):
        k = slot[i]
        p, s = prior[k] if len(prior) else 1.0, noise[k] if len(noise) else 1.0
        right = right and 0 <= p <= 1 and s > 0
        s = min(max(s, bounds[1]), bounds[2])
        table[4 * count + i], table[5 * count + i] = p / (s * s), unit / s
        table[6 * count + i], table[7 * count + i] = p, s
        table[8 * count + i] = quality[k] if len(quality) else 0.0
    for side in sizes:
        right = right and 0 < side < math.inf
    frame[4], frame[5] = unit, 1.0 if right else 0.0
    return count


@inner
def power_of_two(half: float) -> Any:
    """The least power of two that is not smaller, as `PixelFrame.around`."""
    mantissa, exponent = math.frexp(max(half, 1e-300))
    return math.ldexp(1.0, exponent - (1 if mantissa == 0.5 else 0))


@kernel("f8[:, ::1], f8[::1], f8, f8[:, ::1]", brief=True)
def to_pixels(F: Array, centre: Array, unit: float, out: Array) -> bool:
    """As `NormalizedPairs.to_pixels`, of one matrix -> out (3, 3); whether it is finite.

    centre: (4,), of the points in pixels; unit: pixels in one unit of the points.
    """
    T0, T1, product = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            diagonal = (1.0 if i == 2 else 1 / unit) if i == j else 0.0
            T0[i, j] = -centre[i] / unit if i < j == 2 else diagonal
            T1[i, j] = -centre[2 + j] / unit if j < i == 2 else diagonal  # transposed
    _product(T1, F, product)
    _product(product, T0, out)
    largest, squared, finite = out[0, 0], 0.0, True
    for i in range(9):
        entry = out[i // 3, i % 3]
        largest = entry if abs(entry) > abs(largest) else largest
    peak = abs(largest) if largest != 0 else 1.0
    for i in range(9):
        out[i // 3, i % 3] /= peak
        squared += out[i // 3, i % 3] * out[i // 3, i % 3]
    scale, sign = 1 / math.sqrt(squared) if squared != 0 else 0.0, math.copysign(1.0, largest)
    for i in range(9):
        out[i // 3, i % 3] = out[i // 3, i % 3] * scale * sign
        finite = finite and math.isfinite(out[i // 3, i % 3])
    return finite


@inner
def _product(a: Array, b: Array, out: Array) -> None:
    """As `arithmetic.matmul3`."""
    for r in range(3):
        for c in range(3):
            out[r, c] = a[r, 0] * b[0, c] + a[r, 1] * b[1, c] + a[r, 2] * b[2, c]
