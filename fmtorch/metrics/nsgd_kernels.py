"""`nsgd` and `nsgd_released` for one pair, compiled: the same draws and the same sums."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from fmtorch.compiling.arrays import Array, F8x1, F8x2
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.compiling.random_kernels import stream_state, uniform
from fmtorch.compiling.scratch import vector

BLOCK, TRIES, COLUMNS, PARALLEL = 128, 10, 6, 1e-12  # as in `draws`
BORDER, NORMAL_FLOOR = -0.5, 1e-12  # as in `nsgd`
RELEASED_BORDER, NORMAL_OFFSET = 0.5, 1e-10  # as in `nsgd_released`


class Comparison(NamedTuple):
    """Two models of one pair, F_gt, F_est (3, 3), scaled to a largest element of 1.

    size0, size1: (h, w) of the images, pixels. unit: (2,), pixels by which distances in image 0 and 1 are divided.
    released: whether draws are those of `nsgd_released`; F_gt, F_est are then as they were given.
    """

    F_gt: F8x2
    F_est: F8x2
    size0: F8x1
    size1: F8x1
    unit: F8x1
    released: bool


@kernel
def accepted_draws(pair: Comparison, key: int, mixed_seed: int, samples: int, out: F8x1) -> None:
    """`draws.sum_of_draws` of a pair: the sum of its accepted draws, and their number -> out (2,).

    mixed_seed: of the seed and the stream. samples: how many draws to accept.
    """
    state = stream_state(mixed_seed, key)
    u, values = vector(COLUMNS), vector(BLOCK)
    total, count = 0.0, 0
    for start in range(0, TRIES * samples, BLOCK):
        draws = min(BLOCK, TRIES * samples - start)
        for draw in range(draws):
            for column in range(COLUMNS):
                u[column] = uniform(state, (start + draw) * COLUMNS + column)
            value, hits = _released_draw(pair, u) if pair.released else _draw(pair, u)
            taken = hits and count < samples
            values[draw] = value if taken else 0.0
            count += taken
        total += _tree_sum(values, draws)
        if count >= samples:
            break
    out[0], out[1] = total, count


@inner
def _draw(pair: Comparison, u: Array) -> tuple[float, bool]:
    """The value of a draw, and whether it counts."""
    unit = pair.unit
    a0, a1, hits_a = _half_draw(pair.F_gt, pair.F_est, pair.size0, pair.size1, u[:3])
    b0, b1, hits_b = _half_draw(pair.F_est, pair.F_gt, pair.size0, pair.size1, u[3:])
    return ((a0 + b0) / 2 / unit[0] + (a1 + b1) / 2 / unit[1]) / 2, hits_a and hits_b


@inner
def _released_draw(pair: Comparison, u: Array) -> tuple[float, bool]:
    """`_draw` as the released evaluator has it."""
    unit = pair.unit
    a0, a1, hits_a = _released_half(pair.F_gt, pair.F_est, pair.size0, pair.size1, u[:3])
    b1, b0, hits_b = _released_half(pair.F_est, pair.F_gt, pair.size1, pair.size0, u[3:])
    return ((a0 / unit[0] + a1 / unit[1]) / 2 + (b1 / unit[1] + b0 / unit[0]) / 2) / 2, hits_a and hits_b


@inner
def _released_half(F: Array, other: Array, size0: Array, size1: Array, u: Array) -> tuple[float, float, bool]:
    """`_half_draw` as the released evaluator has it."""
    x0, y0 = float(round(u[0] * size0[1])), float(round(u[1] * size0[0]))
    a, b = F[0, 0] * x0 + F[0, 1] * y0 + F[0, 2], F[1, 0] * x0 + F[1, 1] * y0 + F[1, 2]
    c = F[2, 0] * x0 + F[2, 1] * y0 + F[2, 2]
    left, _, right, _, hits = _segment_in_image(a, b, c, size1, RELEASED_BORDER)
    x1 = left + u[2] * (right - left)
    y1 = -(a * x1 + c) / b
    a1, b1 = other[0, 0] * x0 + other[0, 1] * y0 + other[0, 2], other[1, 0] * x0 + other[1, 1] * y0 + other[1, 2]
    c1 = other[2, 0] * x0 + other[2, 1] * y0 + other[2, 2]
    a0, b0 = other[0, 0] * x1 + other[1, 0] * y1 + other[2, 0], other[0, 1] * x1 + other[1, 1] * y1 + other[2, 1]
    c0 = other[0, 2] * x1 + other[1, 2] * y1 + other[2, 2]
    d0 = abs(a0 * x0 + b0 * y0 + c0) / (math.sqrt(a0 * a0 + b0 * b0) + NORMAL_OFFSET)
    return d0, abs(a1 * x1 + b1 * y1 + c1) / (math.sqrt(a1 * a1 + b1 * b1) + NORMAL_OFFSET), hits


@inner
def _half_draw(F: Array, other: Array, size0: Array, size1: Array, u: Array) -> tuple[float, float, bool]:
    """A match exact for F, its distances from the other matrix's lines in images 0 and 1, and whether it counts."""
    x0, y0 = u[0] * size0[1] + BORDER, u[1] * size0[0] + BORDER
    a, b = F[0, 0] * x0 + F[0, 1] * y0 + F[0, 2], F[1, 0] * x0 + F[1, 1] * y0 + F[1, 2]
    c = F[2, 0] * x0 + F[2, 1] * y0 + F[2, 2]
    left, top, right, bottom, hits = _segment_in_image(a, b, c, size1, BORDER)
    x1, y1 = left + u[2] * (right - left), top + u[2] * (bottom - top)
    a1, b1 = other[0, 0] * x0 + other[0, 1] * y0 + other[0, 2], other[1, 0] * x0 + other[1, 1] * y0 + other[1, 2]
    c1 = other[2, 0] * x0 + other[2, 1] * y0 + other[2, 2]
    a0, b0 = other[0, 0] * x1 + other[1, 0] * y1 + other[2, 0], other[0, 1] * x1 + other[1, 1] * y1 + other[2, 1]
    e, floor = abs(a1 * x1 + b1 * y1 + c1), NORMAL_FLOOR * NORMAL_FLOOR
    return e / math.sqrt(a0 * a0 + b0 * b0 + floor), e / math.sqrt(a1 * a1 + b1 * b1 + floor), hits


@inner
def _segment_in_image(
    a: float, b: float, c: float, size: Array, border: float
) -> tuple[float, float, float, float, bool]:
    """`draws.segment_in_image` of a line: x and y of its end points, and whether there are any."""
    half_h, half_w = size[0] / 2, size[1] / 2
    centre_x, centre_y = half_w + border, half_h + border
    squared = a * a + b * b
    scale = 1 / math.sqrt(squared) if squared != 0 else 0.0
    if a > 0 if abs(b * scale) < PARALLEL else b < 0:
        scale = -scale
    a, b = a * scale, b * scale
    c = c * scale + a * centre_x + b * centre_y
    middle_x, reach_x, misses_x = _slab(a * c, b, half_w)
    middle_y, reach_y, misses_y = _slab(-b * c, a, half_h)
    low, high = max(middle_x - reach_x, middle_y - reach_y), min(middle_x + reach_x, middle_y + reach_y)
    hits = low < high and not misses_x and not misses_y and scale != 0
    if not hits:
        low, high = 0.0, 0.0
    x, y = centre_x - a * c, centre_y - b * c
    return x + low * b, y - low * a, x + high * b, y - high * a, hits


@inner
def _slab(offset: float, direction: float, half: float) -> tuple[float, float, bool]:
    """Middle and half-length of the interval where |t direction - offset| <= half, and whether it is empty."""
    if abs(direction) < PARALLEL:
        return 0.0, math.inf, abs(offset) > half
    return offset / direction, half / abs(direction), False


@inner
def _tree_sum(values: Array, n: int) -> Any:
    """The sum of the first n values by halves, in place."""
    while n > 1:
        half = n // 2
        for i in range(half):
            values[i] += values[half + i]
        if n % 2:
            values[half] = values[n - 1]
        n = half + n % 2
    return values[0]
