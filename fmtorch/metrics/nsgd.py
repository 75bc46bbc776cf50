"""Symmetric geometry distance between two fundamental matrices, in pixels (SGD) and in image diagonals (NSGD).

Zhang's procedure (Determining the epipolar geometry and its uncertainty: a review, IJCV 1998, section 5.2), normalised
after Bian et al. (An evaluation of feature matchers for fundamental matrix estimation, BMVC 2019, Algorithm 1):

1. draw a point m uniformly in image 0, and m' uniformly on the part of its line F_gt m that lies inside image 1;
2. d1' = distance of m' to F_est m in image 1, d1 = distance of m to F_est^T m' in image 0;
3. the same with the roles of the two matrices exchanged (points still in image 0, lines in image 1) and a new m.

A draw is accepted when both lines meet image 1; the figure is the mean of the four distances over accepted draws.
It is not symmetric under exchanging the images.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch.core.checks import checked, expect_sizes
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.geometry.epipolar import inverse_root, lines_through, residual_and_normals, unit_largest
from fmtorch.jit.batches import for_each_pair, kernels_serve
from fmtorch.jit.kernel import Array, F8x1, F8x2, inner, kernel, vector
from fmtorch.jit.random import Stream, mixed_seed, stream_state, uniform, uniform_kernel

# `nsgd` and `nsgd_released` for one pair, compiled: the same draws and the same sums


BLOCK_OF_KERNEL, TRIES_OF_KERNEL, COLUMNS_OF_KERNEL, PARALLEL_OF_KERNEL = 128, 10, 6, 1e-12  # as in `draws`
BORDER_OF_KERNEL, NORMAL_FLOOR_OF_KERNEL = -0.5, 1e-12  # as in `nsgd`
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
    """`sum_of_draws` of a pair: the sum of its accepted draws, and their number -> out (2,).

    mixed_seed: of the seed and the stream. samples: how many draws to accept.
    """
    state = stream_state(mixed_seed, key)
    u, values = vector(COLUMNS_OF_KERNEL), vector(BLOCK_OF_KERNEL)
    total, count = 0.0, 0
    for start in range(0, TRIES_OF_KERNEL * samples, BLOCK_OF_KERNEL):
        draws = min(BLOCK_OF_KERNEL, TRIES_OF_KERNEL * samples - start)
        for draw in range(draws):
            for column in range(COLUMNS_OF_KERNEL):
                u[column] = uniform_kernel(state, (start + draw) * COLUMNS_OF_KERNEL + column)
            value, hits = _released_draw(pair, u) if pair.released else _draw(pair, u)
            taken = hits and count < samples
            values[draw] = value if taken else 0.0
            count += taken
        total += _tree_sum_kernel(values, draws)
        if count >= samples:
            break
    out[0], out[1] = total, count


@inner
def _draw(pair: Comparison, u: Array) -> tuple[float, bool]:
    """The value of a draw, and whether it counts."""
    unit = pair.unit
    a0, a1, hits_a = _half_draw_kernel(pair.F_gt, pair.F_est, pair.size0, pair.size1, u[:3])
    b0, b1, hits_b = _half_draw_kernel(pair.F_est, pair.F_gt, pair.size0, pair.size1, u[3:])
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
def _half_draw_kernel(F: Array, other: Array, size0: Array, size1: Array, u: Array) -> tuple[float, float, bool]:
    """A match exact for F, its distances from the other matrix's lines in images 0 and 1, and whether it counts."""
    x0, y0 = u[0] * size0[1] + BORDER_OF_KERNEL, u[1] * size0[0] + BORDER_OF_KERNEL
    a, b = F[0, 0] * x0 + F[0, 1] * y0 + F[0, 2], F[1, 0] * x0 + F[1, 1] * y0 + F[1, 2]
    c = F[2, 0] * x0 + F[2, 1] * y0 + F[2, 2]
    left, top, right, bottom, hits = _segment_in_image(a, b, c, size1, BORDER_OF_KERNEL)
    x1, y1 = left + u[2] * (right - left), top + u[2] * (bottom - top)
    a1, b1 = other[0, 0] * x0 + other[0, 1] * y0 + other[0, 2], other[1, 0] * x0 + other[1, 1] * y0 + other[1, 2]
    c1 = other[2, 0] * x0 + other[2, 1] * y0 + other[2, 2]
    a0, b0 = other[0, 0] * x1 + other[1, 0] * y1 + other[2, 0], other[0, 1] * x1 + other[1, 1] * y1 + other[2, 1]
    e, floor = abs(a1 * x1 + b1 * y1 + c1), NORMAL_FLOOR_OF_KERNEL * NORMAL_FLOOR_OF_KERNEL
    return e / math.sqrt(a0 * a0 + b0 * b0 + floor), e / math.sqrt(a1 * a1 + b1 * b1 + floor), hits


@inner
def _segment_in_image(
    a: float, b: float, c: float, size: Array, border: float
) -> tuple[float, float, float, float, bool]:
    """`segment_in_image` of a line: x and y of its end points, and whether there are any."""
    half_h, half_w = size[0] / 2, size[1] / 2
    centre_x, centre_y = half_w + border, half_h + border
    squared = a * a + b * b
    scale = 1 / math.sqrt(squared) if squared != 0 else 0.0
    if a > 0 if abs(b * scale) < PARALLEL_OF_KERNEL else b < 0:
        scale = -scale
    a, b = a * scale, b * scale
    c = c * scale + a * centre_x + b * centre_y
    middle_x, reach_x, misses_x = _slab_kernel(a * c, b, half_w)
    middle_y, reach_y, misses_y = _slab_kernel(-b * c, a, half_h)
    low, high = max(middle_x - reach_x, middle_y - reach_y), min(middle_x + reach_x, middle_y + reach_y)
    hits = low < high and not misses_x and not misses_y and scale != 0
    if not hits:
        low, high = 0.0, 0.0
    x, y = centre_x - a * c, centre_y - b * c
    return x + low * b, y - low * a, x + high * b, y - high * a, hits


@inner
def _slab_kernel(offset: float, direction: float, half: float) -> tuple[float, float, bool]:
    """Middle and half-length of the interval where |t direction - offset| <= half, and whether it is empty."""
    if abs(direction) < PARALLEL_OF_KERNEL:
        return 0.0, math.inf, abs(offset) > half
    return offset / direction, half / abs(direction), False


@inner
def _tree_sum_kernel(values: Array, n: int) -> Any:
    """The sum of the first n values by halves, in place."""
    while n > 1:
        half = n // 2
        for i in range(half):
            values[i] += values[half + i]
        if n % 2:
            values[half] = values[n - 1]
        n = half + n % 2
    return values[0]


# Monte-Carlo means over virtual points: the part of a line inside an image, and draws until enough are accepted


COLUMNS = 6  # random numbers of a draw: for each of its two halves a point (x, y) and a place on its line
BLOCK = 128  # draws made before pairs with enough accepted ones are left out
TRIES = 10  # draws made at most, per accepted draw wanted
TILE = 1 << 16  # draws computed at a time, which bounds memory to some tens of MB
PARALLEL = 1e-12  # sine of the angle below which a line does not cross a border: 1e-8 px over 10,000 px


@dataclass(frozen=True)
class Pairs:
    """Pairs with their leading dimensions flattened to one, in float64; sizes are (h, w)."""

    F_gt: Float[Tensor, "b 3 3"]
    F_est: Float[Tensor, "b 3 3"]
    size0: Float[Tensor, "b 2"]
    size1: Float[Tensor, "b 2"]
    key: Int[Tensor, " b"]

    @staticmethod
    def flatten(
        F_gt: Float[Tensor, "*#batch 3 3"],
        F_est: Float[Tensor, "*#batch 3 3"],
        size0: Real[Tensor, "*#batch 2"],
        size1: Real[Tensor, "*#batch 2"],
        key: Int[Tensor, "*#batch"] | None,
    ) -> tuple[Pairs, torch.Size]:
        """The pairs and their common leading shape; without keys every key is 0. Raises ValueError for wrong sizes."""
        expect_sizes(size0=size0, size1=size1)
        if key is None:
            key = torch.zeros((), dtype=torch.int64, device=F_est.device)
        shape = (F_gt[..., 0, 0] + F_est[..., 0, 0] + size0[..., 0] + size1[..., 0] + key).shape

        def flat(value: Tensor, *tail: int) -> Tensor:
            return value.to(torch.float64).expand(*shape, *tail).reshape(-1, *tail)

        pairs = Pairs(
            flat(F_gt, 3, 3), flat(F_est, 3, 3), flat(size0, 2), flat(size1, 2), key.expand(shape).reshape(-1)
        )
        return pairs, shape

    def take(self, index: Int[Tensor, " picked"] | slice) -> Pairs:
        """The selected pairs."""
        return Pairs(self.F_gt[index], self.F_est[index], self.size0[index], self.size1[index], self.key[index])


def diagonal(size: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """Length of the image diagonal, in pixels."""
    h, w = size.unbind(-1)
    return sqrt(h * h + w * w)


Draw = Callable[[Pairs, Tensor], tuple[Tensor, Tensor]]


def sum_of_draws(pairs: Pairs, draw: Draw, *, samples: int, seed: int) -> tuple[Float[Tensor, " b"], Int[Tensor, " b"]]:
    """Sum of the first `samples` accepted draws of each pair, and how many there are among 10 x `samples` tries.

    `draw` maps pairs and their uniform numbers (b, draws, 6) to values and accepted flags, both (b, draws).
    """
    expect_samples(samples)
    step = max(1, TILE // BLOCK)
    starts = range(0, max(1, len(pairs.key)), step)  # one empty tile for an empty batch
    parts = [_sum_of_tile(pairs.take(slice(i, i + step)), draw, samples, seed) for i in starts]
    return torch.cat([total for total, _ in parts]), torch.cat([count for _, count in parts])


def expect_samples(samples: int) -> None:
    """Raises ValueError unless there is at least one."""
    if samples < 1:
        raise ValueError(f"samples is {samples}; it must be at least 1")


def _sum_of_tile(pairs: Pairs, draw: Draw, samples: int, seed: int) -> tuple[Tensor, Tensor]:
    """`sum_of_draws` of one tile; pairs with enough accepted draws are left out of later blocks."""
    total, count = torch.zeros_like(pairs.size0[:, 0]), torch.zeros_like(pairs.key)
    active = torch.arange(len(count), device=count.device)
    for start in range(0, TRIES * samples, BLOCK):
        current = pairs.take(active)
        draws = min(BLOCK, TRIES * samples - start)
        value, accepted = draw(current, uniform(seed, current.key, Stream.METRIC, start, draws, COLUMNS))
        taken = accepted & (count[active, None] + accepted.cumsum(-1) <= samples)
        total = total.index_add(0, active, _tree_sum(torch.where(taken, value, 0.0)))
        count = count.index_add(0, active, taken.sum(-1))
        active = active[count[active] < samples]
        if not len(active):
            break
    return total, count


def _tree_sum(values: Float[Tensor, "b n"]) -> Float[Tensor, " b"]:
    """Sum over the last dimension by halves: the order depends on n alone."""
    while values.shape[-1] > 1:
        half = values.shape[-1] // 2
        folded = values[:, :half] + values[:, half : 2 * half]
        values = torch.cat([folded, values[:, 2 * half :]], -1)
    return values[:, 0]


def segment_in_image(
    line: list[Tensor], size: Float[Tensor, "b 2"], origin: float
) -> tuple[Float[Tensor, "b n 2"], Float[Tensor, "b n 2"], Bool[Tensor, "b n"]]:
    """End points of the part of each line inside the rectangle (origin, origin + size), and whether there is one.

    `line` holds the components a, b, c (b, n) at any scale, sign and direction. The first end point is the left one,
    or the upper one of a vertical line. End points of lines that miss mean nothing but are finite.
    """
    half_h, half_w = (size / 2)[:, :, None].unbind(1)
    centre_x, centre_y = half_w + origin, half_h + origin
    a, b, c = line
    scale = inverse_root(a * a + b * b)
    vertical = (b * scale).abs() < PARALLEL
    scale = torch.where(torch.where(vertical, a > 0, b < 0), -scale, scale)  # makes t run from left to right
    a, b = a * scale, b * scale
    c = c * scale + a * centre_x + b * centre_y
    # Seen from the centre the line is (-a c, -b c) + t (b, -a); each pair of borders cuts an interval of t out of it.
    middle_x, reach_x, misses_x = _slab(a * c, b, half_w)
    middle_y, reach_y, misses_y = _slab(-b * c, a, half_h)
    low = torch.maximum(middle_x - reach_x, middle_y - reach_y)
    high = torch.minimum(middle_x + reach_x, middle_y + reach_y)
    hits = (low < high) & ~misses_x & ~misses_y & (scale != 0)

    def point(t: Tensor) -> Tensor:
        t = torch.where(hits, t, 0.0)
        return torch.stack([centre_x - a * c + t * b, centre_y - b * c - t * a], -1)

    return point(low), point(high), hits


def _slab(offset: Tensor, direction: Tensor, half: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Middle and half-length of the interval where |t direction - offset| <= half, and whether it is empty."""
    parallel = direction.abs() < PARALLEL
    divisor = torch.where(parallel, 1.0, direction)
    middle = torch.where(parallel, 0.0, offset) / divisor
    reach = torch.where(parallel, torch.inf, half / divisor.abs())
    return middle, reach, parallel & (offset.abs() > half)


BORDER = -0.5  # left and top edge of the first pixel
NORMAL_FLOOR = 1e-12  # length of a normal, for F of unit size, that is as good as none: its line is at infinity


@checked
def sgd(
    F_gt: Float[Tensor, "*#batch 3 3"],
    F_est: Float[Tensor, "*#batch 3 3"],
    size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"],
    *,
    samples: int = 1000,
    seed: int = 0,
    key: Int[Tensor, "*#batch"] | None = None,
    cap: bool = True,
) -> Float[Tensor, "*#batch"]:
    """Symmetric geometry distance in pixels, at most the mean of the two image diagonals; otherwise as `nsgd`.

    Args:
        F_gt: true fundamental matrices (..., 3, 3), of any scale and sign.
        F_est: estimated ones.
        size0: sizes (..., 2) of image 0 as (h, w).
        size1: those of image 1.
        samples: accepted draws.
        seed: of the draws.
        key: (...), the pairs' keys.
        cap: whether the value has that limit.

    Returns:
        (...).
    """
    return _mean_distance(torch.ones_like, F_gt, F_est, size0, size1, samples, seed, key, cap)


@checked
def nsgd(
    F_gt: Float[Tensor, "*#batch 3 3"],
    F_est: Float[Tensor, "*#batch 3 3"],
    size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"],
    *,
    samples: int = 1000,
    seed: int = 0,
    key: Int[Tensor, "*#batch"] | None = None,
    cap: bool = True,
) -> Float[Tensor, "*#batch"]:
    """Normalised symmetric geometry distance: each distance divided by the diagonal of the image it is measured in.

    The value is 1 where no draw is accepted, and where a matrix is zero or not finite.

    Args:
        F_gt: true fundamental matrices (..., 3, 3), of any scale and sign.
        F_est: estimated ones.
        size0: sizes (..., 2) of image 0 as (h, w).
        size1: those of image 1.
        samples: accepted draws, of at most ten times as many tries.
        seed: of the draws.
        key: (...), the pairs' keys, which select their random points; with the same key and seed the points are the
            same.
        cap: limit the mean to 1. Without it the value is a loss, differentiable with respect to both matrices and
            unbounded.

    Returns:
        (...), at least 0.

    Example:
        >>> import torch
        >>> from fmtorch.metrics import nsgd
        >>> rows = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a sideways camera
        >>> columns = torch.tensor([[0.0, 0, 1], [0, 0, 0], [-1, 0, 0]])  # one that moves up
        >>> size = torch.tensor([480, 640])
        >>> round(nsgd(rows, 5 * rows, size, size).item(), 6), bool(nsgd(rows, columns, size, size) > 0.05)
        (0.0, True)
    """
    return _mean_distance(torch.clone, F_gt, F_est, size0, size1, samples, seed, key, cap)


def draw_distances(
    pairs: Pairs, uniforms: Float[Tensor, "b n 6"]
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """Of each draw the mean distances in pixels in images 0 and 1 over its two halves, and whether it counts."""
    first, second = uniforms[..., :3], uniforms[..., 3:]
    a0, a1, hits_a = _half_draw(pairs.F_gt, pairs.F_est, pairs.size0, pairs.size1, first)
    b0, b1, hits_b = _half_draw(pairs.F_est, pairs.F_gt, pairs.size0, pairs.size1, second)
    return (a0 + b0) / 2, (a1 + b1) / 2, hits_a & hits_b


def _half_draw(
    F: Tensor, F_other: Tensor, size0: Tensor, size1: Tensor, uniforms: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Steps 1 and 2: a match (m, m') exact for F, and its distances from the lines of F_other in images 0 and 1."""
    m = uniforms[..., :2] * size0.flip(-1)[:, None] + BORDER
    start, end, hits = segment_in_image(lines_through(F, m), size1, BORDER)
    m_prime = start + uniforms[..., 2:] * (end - start)
    e, squared0, squared1 = residual_and_normals(F_other, m, m_prime)
    floor = NORMAL_FLOOR**2
    return e.abs() / sqrt(squared0 + floor), e.abs() / sqrt(squared1 + floor), hits


def _mean_distance(
    unit: Callable[[Tensor], Tensor],
    F_gt: Tensor,
    F_est: Tensor,
    size0: Tensor,
    size1: Tensor,
    samples: int,
    seed: int,
    key: Tensor | None,
    cap: bool,
) -> Tensor:
    """Mean over accepted draws; `unit` makes of an image's diagonal the length its distances are divided by."""
    pairs, shape = Pairs.flatten(F_gt, F_est, size0, size1, key)
    valid = pairs.F_gt.isfinite().all(-1).all(-1) & pairs.F_est.isfinite().all(-1).all(-1)
    scaled = [unit_largest(torch.where(valid[:, None, None], F, 0.0)) for F in (pairs.F_gt, pairs.F_est)]
    pairs = replace(pairs, F_gt=scaled[0], F_est=scaled[1])

    def draw(tile: Pairs, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        d0, d1, accepted = draw_distances(tile, uniforms)
        unit0, unit1 = unit(diagonal(tile.size0)), unit(diagonal(tile.size1))
        return (d0 / unit0[:, None] + d1 / unit1[:, None]) / 2, accepted

    if kernels_serve(pairs.F_gt, pairs.F_est, pairs.size0, pairs.size1):
        total, count = compiled_sums(unit, pairs, samples, seed)
    else:
        total, count = sum_of_draws(pairs, draw, samples=samples, seed=seed)
    diagonal0, diagonal1 = diagonal(pairs.size0), diagonal(pairs.size1)
    worst = (diagonal0 / unit(diagonal0) + diagonal1 / unit(diagonal1)) / 2
    value = torch.where(count > 0, total / count.clamp(min=1), worst)
    return (torch.minimum(value, worst) if cap else value).reshape(shape).to(F_est.dtype)


def compiled_sums(
    unit: Callable[[Tensor], Tensor], pairs: Pairs, samples: int, seed: int, released: bool = False
) -> tuple[Float[Tensor, " b"], Float[Tensor, " b"]]:
    """Sum and number of the accepted draws of each pair, by the kernel. released: draws of `nsgd_released`."""
    expect_samples(samples)
    units = torch.stack([unit(diagonal(size)) for size in (pairs.size0, pairs.size1)], -1)
    tensors = (pairs.F_gt, pairs.F_est, pairs.size0, pairs.size1, units, pairs.key[:, None])
    constants = (released, mixed_seed(seed, Stream.METRIC), samples)
    out = torch.empty(len(units), 2, dtype=torch.float64)
    terms = for_each_pair(_into, tensors, *constants, out=out, kind=torch.float64)
    return terms[:, 0], terms[:, 1]


def _into(
    F_gt: Array, F_est: Array, size0: Array, size1: Array, unit: Array, key: Array, released: bool, seed: int,
    samples: int, out: Array,
) -> None:  # fmt: skip
    accepted_draws(Comparison(F_gt, F_est, size0, size1, unit, released), int(key[0]), seed, samples, out)
