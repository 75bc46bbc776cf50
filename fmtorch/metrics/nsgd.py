"""Symmetric geometry distance between two fundamental matrices, in pixels (SGD) and in image diagonals (NSGD).

Zhang's procedure (Determining the epipolar geometry and its uncertainty: a review, IJCV 1998, section 5.2), normalised
after Bian et al. (An evaluation of feature matchers for fundamental matrix estimation, BMVC 2019, Algorithm 1):

1. draw a point m uniformly in image 0, and m' uniformly on the part of its line F_gt m that lies inside image 1;
2. d1' = distance of m' to F_est m in image 1, d1 = distance of m to F_est^T m' in image 0;
3. the same with the roles of the two matrices exchanged (points still in image 0, lines in image 1) and a new m.

A draw is accepted when both lines meet image 1; the figure is the mean of the four distances over accepted draws.
It is not symmetric under exchanging the images."""

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int, Real
from torch import Tensor

from fmtorch.core.checks import checked, expect_sizes
from fmtorch.geometry import epipolar
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.jit.kernel import Array, F8x1, F8x2, F8x3, I8x1, for_each_pair, inner, kernel, vector
from fmtorch.jit.random import Stream, mixed_seed, stream_state, uniform_kernel

COLUMNS = 6  # random numbers of a draw: for each of its two halves a point (x, y) and a place on its line
BLOCK = 128  # draws summed together
TRIES = 10  # draws made at most, per accepted draw wanted
PARALLEL = 1e-12  # sine of the angle below which a line does not cross a border: 1e-8 px over 10,000 px
BORDER = -0.5  # left and top edge of the first pixel
NORMAL_FLOOR = 1e-12  # length of a normal, for F of unit size, that is as good as none: its line is at infinity
Two = tuple[Tensor, Tensor]
RELEASED_BORDER, NORMAL_OFFSET = 0.5, 1e-10  # of `nsgd_released`: pixels count from 1; added to the length of a normal


class Comparison(NamedTuple):
    """Two models of each pair, or of one, F_gt, F_est (3, 3), for `nsgd` scaled to a largest element of 1.
    size0, size1: (h, w), px. unit: (2,), by which distances in images 0 and 1 are divided, px. key: (1,), of draws."""

    F_gt: F8x2
    F_est: F8x2
    size0: F8x1
    size1: F8x1
    unit: F8x1
    key: I8x1


@checked
def sgd(
    F_gt: Float[Tensor, "*#batch 3 3"], F_est: Float[Tensor, "*#batch 3 3"], size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"], *, samples: int = 1000, seed: int = 0, key: Int[Tensor, "*#batch"] | None = None,
    cap: bool = True,
) -> Float[Tensor, "*#batch"]:  # fmt: skip
    """Symmetric geometry distance in pixels, at most the mean of the two image diagonals; otherwise as `nsgd`."""
    return _mean_distance(False, (F_gt, F_est), (size0, size1), samples, seed, key, cap)


@checked
def nsgd(
    F_gt: Float[Tensor, "*#batch 3 3"], F_est: Float[Tensor, "*#batch 3 3"], size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"], *, samples: int = 1000, seed: int = 0, key: Int[Tensor, "*#batch"] | None = None,
    cap: bool = True,
) -> Float[Tensor, "*#batch"]:  # fmt: skip
    """Normalised symmetric geometry distance: each distance divided by the diagonal of the image it is measured in.

    The value is at least 0, and 1 where no draw is accepted or a matrix is zero or not finite.

    Args:
        F_gt, F_est: true and estimated fundamental matrices (..., 3, 3), of any scale and sign.
        size0, size1: sizes (..., 2) of the images as (h, w).
        samples: accepted draws, of at most ten times as many tries.
        seed, key: of all draws, and (...) of each pair; together they select its random points.
        cap: limit the mean to 1. Without it the value is an unbounded loss, differentiable in both matrices.

    Example:
        >>> import torch
        >>> from fmtorch.metrics import nsgd
        >>> rows = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a sideways camera
        >>> columns = torch.tensor([[0.0, 0, 1], [0, 0, 0], [-1, 0, 0]])  # one that moves up
        >>> size = torch.tensor([480, 640])
        >>> round(nsgd(rows, 5 * rows, size, size).item(), 6), bool(nsgd(rows, columns, size, size) > 0.05)
        (0.0, True)
    """
    return _mean_distance(True, (F_gt, F_est), (size0, size1), samples, seed, key, cap)


def _mean_distance(
    normalised: bool, models: Two, sizes: Two, samples: int, seed: int, key: Tensor | None, cap: bool
) -> Tensor:
    """Mean over accepted draws of the distances in pixels, or `normalised`, in diagonals of the images."""
    pairs, shape = _flattened(*models, *sizes, samples, key)
    F = torch.stack(pairs[:2], 1)
    valid = F.detach().isfinite().flatten(1).all(1)
    F = epipolar.unit_largest(torch.where(valid[:, None, None, None], F, 0.0))
    diagonals = torch.stack([diagonal(size) for size in pairs[2:4]], 1)
    units = diagonals if normalised else torch.ones_like(diagonals)
    tensors = (*F.unbind(1), *pairs[2:4], units, pairs[4])
    constants = mixed_seed(seed, Stream.METRIC), samples
    out = torch.empty(len(F), 2, dtype=torch.float64)
    sums = for_each_pair(sum_of_draws, tensors, *constants, False, out=out, kind=torch.float64, group=Comparison)
    total, count = sums.unbind(1)
    if F.requires_grad:
        out = torch.empty(F.shape, dtype=torch.float64)
        slope = for_each_pair(gradient_of_draws, tensors, *constants, out=out, kind=torch.float64, group=Comparison)
        total = total + (slope * (F - F.detach())).sum((1, 2, 3))  # adds zeros
    worst = (diagonals / units).sum(1) / 2
    value = torch.where(count > 0, total / count.clamp(min=1), worst)
    return (torch.minimum(value, worst) if cap else value).reshape(shape).to(models[1].dtype)


@checked
@torch.no_grad()
def nsgd_released(
    F_gt: Float[Tensor, "*#batch 3 3"], F_est: Float[Tensor, "*#batch 3 3"], size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"], *, samples: int = 1000, seed: int = 0, key: Int[Tensor, "*#batch"] | None = None,
) -> Float[Tensor, "*#batch"]:  # fmt: skip
    """NSGD exactly as the released FM-Bench evaluator computes it, faults included; arguments as `nsgd`.

    What differs from `nsgd` (github.com/JiawangBian/FM-Bench, ComputeNormlizedSGD.m):

    - the sum over accepted draws is divided by `samples`, however few they are: an estimate without any gets 0;
    - the second half exchanges the image sizes together with the matrices, without transposing them;
    - the point on a line is y = -(a x + c) / b: one exactly vertical line among the draws makes the figure 1;
    - virtual points are rounded to whole pixels 0 .. w, 0 .. h, and image borders lie at 0.5 and size + 0.5;
    - 1e-10 is added to the length of a line's normal, so the figure depends on the scale of very small matrices.

    The matrices are used as they are given, in pixels from 0 or from 1. A failed estimate, zero or not finite, gets 1:
    the evaluator never measures those and counts them as misses. Not differentiable; `nsgd` is."""
    (F_gt, F_est, size0, size1, key), shape = _flattened(F_gt, F_est, size0, size1, samples, key)
    tensors = (F_gt, F_est, size0, size1, torch.stack([diagonal(size) for size in (size0, size1)], 1), key)
    constants = mixed_seed(seed, Stream.METRIC), samples, True
    out = torch.empty(len(F_est), 2, dtype=torch.float64)
    sums = for_each_pair(sum_of_draws, tensors, *constants, out=out, kind=torch.float64, group=Comparison)
    value = (sums[:, 0] / samples).clamp(max=1.0)
    failed = ~F_est.isfinite().flatten(1).all(1) | (F_est == 0).flatten(1).all(1)
    return torch.where(failed | value.isnan(), 1.0, value).reshape(shape).to(F_est.dtype)


def _flattened(
    F_gt: Tensor, F_est: Tensor, size0: Tensor, size1: Tensor, samples: int, key: Tensor | None
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor, Tensor], torch.Size]:
    """Matrices, sizes (b, 2) and keys (b, 1) with the leading dimensions flattened to one, in float64; their shape.
    Without keys every key is 0. Raises ValueError for wrong sizes, and for less than one sample."""
    expect_sizes(size0=size0, size1=size1)
    if samples < 1:
        raise ValueError(f"samples is {samples}; it must be at least 1")
    key = torch.zeros((), dtype=torch.int64, device=F_est.device) if key is None else key
    shapes = (F_gt.shape[:-2], F_est.shape[:-2], size0.shape[:-1], size1.shape[:-1], key.shape)
    shape = torch.Size(torch.broadcast_shapes(*shapes))  # type: ignore[no-untyped-call]

    def flat(value: Tensor, *tail: int) -> Tensor:
        return value.to(torch.float64).expand(*shape, *tail).reshape(-1, *tail)

    pairs = flat(F_gt, 3, 3), flat(F_est, 3, 3), flat(size0, 2), flat(size1, 2), key.expand(shape).reshape(-1, 1)
    return pairs, shape


def diagonal(size: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """Length of the image diagonal, in pixels."""
    h, w = size.unbind(-1)
    return sqrt(h * h + w * w)


@kernel
def sum_of_draws(pair: Comparison, mixed_seed: int, samples: int, released: bool, out: F8x1) -> None:
    """The sum of the first accepted draws of a pair, and their number -> out (2,).
    mixed_seed: of the seed and the stream. samples: draws to accept, of 10 x as many. released: as `nsgd_released`."""
    state, u, values = stream_state(mixed_seed, pair.key[0]), vector(COLUMNS), vector(BLOCK)
    total, count = 0.0, 0
    for start in range(0, TRIES * samples, BLOCK):
        draws = min(BLOCK, TRIES * samples - start)
        for draw in range(draws):
            _uniform_numbers(state, start + draw, u)
            value, hits = released_draw(pair, u) if released else plain_draw(pair, u)
            taken = hits and count < samples
            values[draw] = value if taken else 0.0
            count += taken
        total += _tree_sum(values, draws)
        if count >= samples:
            break
    out[0], out[1] = total, count


@kernel
def gradient_of_draws(pair: Comparison, mixed_seed: int, samples: int, out: F8x3) -> None:
    """The gradient of the sum of `sum_of_draws` with respect to F_gt and F_est -> out (2, 3, 3); not `released`."""
    state, u, count = stream_state(mixed_seed, pair.key[0]), vector(COLUMNS), 0
    out[:] = 0
    for draw in range(TRIES * samples):
        _uniform_numbers(state, draw, u)
        if plain_draw(pair, u)[1]:
            _add_gradient(pair.F_gt, pair.F_est, pair, u[:3], out[0], out[1])
            _add_gradient(pair.F_est, pair.F_gt, pair, u[3:], out[1], out[0])
            count += 1
        if count == samples:
            break


@inner
def _uniform_numbers(state: Any, draw: int, u: Array) -> None:
    for column in range(len(u)):
        u[column] = uniform_kernel(state, draw * len(u) + column)


@inner
def plain_draw(pair: Comparison, u: Array) -> tuple[float, bool]:
    """The value of a draw, and whether it counts."""
    unit = pair.unit
    a0, a1, hits_a = _half_draw(pair.F_gt, pair.F_est, pair.size0, pair.size1, u[:3])
    b0, b1, hits_b = _half_draw(pair.F_est, pair.F_gt, pair.size0, pair.size1, u[3:])
    return ((a0 + b0) / 2 / unit[0] + (a1 + b1) / 2 / unit[1]) / 2, hits_a and hits_b


@inner
def _half_draw(F: Array, other: Array, size0: Array, size1: Array, u: Array) -> tuple[float, float, bool]:
    """Steps 1 and 2: d0 and d1 of a match exact for F from the lines of the other matrix, and whether it counts."""
    x0, y0 = u[0] * size0[1] + BORDER, u[1] * size0[0] + BORDER
    a, b, c = line_of(F, x0, y0)
    left, top, right, bottom, hits = segment_in_image(a, b, c, size1, BORDER)
    x1, y1 = left + u[2] * (right - left), top + u[2] * (bottom - top)
    e, a0, b0, a1, b1 = _residual(other, x0, y0, x1, y1)
    floor = NORMAL_FLOOR * NORMAL_FLOOR
    return abs(e) / math.sqrt(a0 * a0 + b0 * b0 + floor), abs(e) / math.sqrt(a1 * a1 + b1 * b1 + floor), hits


@inner
def _residual(F: Array, x0: float, y0: float, x1: float, y1: float) -> tuple[float, float, float, float, float]:
    """``x1^T F x0``, and the normals of the lines in images 0 and 1."""
    a0, b0, _ = line_of(F.T, x1, y1)
    a1, b1, c1 = line_of(F, x0, y0)
    return a1 * x1 + b1 * y1 + c1, a0, b0, a1, b1


@inner
def _add_gradient(F: Array, other: Array, pair: Comparison, u: Array, of_F: Array, of_other: Array) -> None:
    """Adds to two gradients that of a half's part of the value, ``(d0 / unit0 + d1 / unit1) / 4``."""
    size0, size1 = pair.size0, pair.size1
    x0, y0 = u[0] * size0[1] + BORDER, u[1] * size0[0] + BORDER
    a, b, c = line_of(F, x0, y0)
    left, top, right, bottom, _ = segment_in_image(a, b, c, size1, BORDER)
    x1, y1 = left + u[2] * (right - left), top + u[2] * (bottom - top)
    e, a0, b0, a1, b1 = _residual(other, x0, y0, x1, y1)
    floor = NORMAL_FLOOR * NORMAL_FLOOR
    squared0, squared1 = a0 * a0 + b0 * b0 + floor, a1 * a1 + b1 * b1 + floor
    weight0, weight1 = 0.25 / (math.sqrt(squared0) * pair.unit[0]), 0.25 / (math.sqrt(squared1) * pair.unit[1])
    of_e = math.copysign(weight0 + weight1, e)
    of_normal0, of_normal1 = -abs(e) * weight0 / squared0, -abs(e) * weight1 / squared1
    m0, m1 = (x0, y0, 1.0), (x1, y1, 1.0)
    for i in range(3):
        for j in range(3):
            of_other[i, j] += of_e * m1[i] * m0[j]
        of_other[i, 0] += of_normal0 * a0 * m1[i]
        of_other[i, 1] += of_normal0 * b0 * m1[i]
        of_other[0, i] += of_normal1 * a1 * m0[i]
        of_other[1, i] += of_normal1 * b1 * m0[i]
    of_x = of_e * a1 + of_normal0 * (a0 * other[0, 0] + b0 * other[0, 1])
    of_y = of_e * b1 + of_normal0 * (a0 * other[1, 0] + b0 * other[1, 1])
    for x, y, share in ((left, top, 1 - u[2]), (right, bottom, u[2])):
        # With the line an end moves along its border: one on the left or right border up and down, another sideways.
        to_side = abs(abs(x - size1[1] / 2 - BORDER) - size1[1] / 2)
        to_top = abs(abs(y - size1[0] / 2 - BORDER) - size1[0] / 2)
        step = share * (of_y / b if to_side < to_top else of_x / a)
        for j in range(3):
            of_F[0, j] -= step * x * m0[j]
            of_F[1, j] -= step * y * m0[j]
            of_F[2, j] -= step * m0[j]


@inner
def released_draw(pair: Comparison, u: Array) -> tuple[float, bool]:
    """`plain_draw` as the released evaluator has it: NaN or infinite on vertical lines."""
    unit = pair.unit
    a0, a1, hits_a = _released_half(pair.F_gt, pair.F_est, pair.size0, pair.size1, u[:3])
    b1, b0, hits_b = _released_half(pair.F_est, pair.F_gt, pair.size1, pair.size0, u[3:])
    return ((a0 / unit[0] + a1 / unit[1]) / 2 + (b1 / unit[1] + b0 / unit[0]) / 2) / 2, hits_a and hits_b


@inner
def _released_half(F: Array, other: Array, size0: Array, size1: Array, u: Array) -> tuple[float, float, bool]:
    """`_half_draw` as the released evaluator has it."""
    x0, y0 = float(round(u[0] * size0[1])), float(round(u[1] * size0[0]))
    a, b, c = line_of(F, x0, y0)
    left, _, right, _, hits = segment_in_image(a, b, c, size1, RELEASED_BORDER)
    x1 = left + u[2] * (right - left)
    y1 = -(a * x1 + c) / b
    a1, b1, c1 = line_of(other, x0, y0)
    a0, b0, c0 = line_of(other.T, x1, y1)
    d0 = abs(a0 * x0 + b0 * y0 + c0) / (math.sqrt(a0 * a0 + b0 * b0) + NORMAL_OFFSET)
    return d0, abs(a1 * x1 + b1 * y1 + c1) / (math.sqrt(a1 * a1 + b1 * b1) + NORMAL_OFFSET), hits


@inner
def line_of(F: Array, x: float, y: float) -> tuple[float, float, float]:
    """F (x, y, 1)."""
    a, b = F[0, 0] * x + F[0, 1] * y + F[0, 2], F[1, 0] * x + F[1, 1] * y + F[1, 2]
    return a, b, F[2, 0] * x + F[2, 1] * y + F[2, 2]


@inner
def segment_in_image(a: float, b: float, c: float, size: Array, edge: float) -> tuple[float, float, float, float, bool]:
    """x and y of the ends of the part of a line inside the rectangle (edge, edge + size); whether there is one.
    The line may have any scale, sign and direction. The left end is first, or the upper one of a vertical line."""
    half_h, half_w = size[0] / 2, size[1] / 2
    centre_x, centre_y = half_w + edge, half_h + edge
    squared = a * a + b * b
    scale = 1 / math.sqrt(squared) if squared != 0 else 0.0
    if a > 0 if abs(b * scale) < PARALLEL else b < 0:
        scale = -scale  # t runs from left to right
    a, b = a * scale, b * scale
    c = c * scale + a * centre_x + b * centre_y
    # Seen from the centre the line is (-a c, -b c) + t (b, -a); each pair of borders cuts an interval of t out of it.
    middle_x, reach_x, misses_x = _interval(a * c, b, half_w)
    middle_y, reach_y, misses_y = _interval(-b * c, a, half_h)
    low, high = max(middle_x - reach_x, middle_y - reach_y), min(middle_x + reach_x, middle_y + reach_y)
    hits = low < high and not misses_x and not misses_y and scale != 0
    if not hits:
        low, high = 0.0, 0.0
    x, y = centre_x - a * c, centre_y - b * c
    return x + low * b, y - low * a, x + high * b, y - high * a, hits


@inner
def _interval(offset: float, direction: float, half: float) -> tuple[float, float, bool]:
    """Middle and half-length of the interval where |t direction - offset| <= half, and whether it is empty."""
    if abs(direction) < PARALLEL:
        return 0.0, math.inf, abs(offset) > half
    return offset / direction, half / abs(direction), False


@inner
def _tree_sum(values: Array, n: int) -> Any:
    """The sum of the first n values by halves, in place: the order depends on n alone."""
    while n > 1:
        half = n // 2
        for i in range(half):
            values[i] += values[half + i]
        if n % 2:
            values[half] = values[n - 1]
        n = half + n % 2
    return values[0]
