"""Monte-Carlo means over virtual points: the part of a line inside an image, and draws until enough are accepted.

Everything is elementwise or summed in a fixed tree, so a pair's figure is bit-equal whatever the batch and the tile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch.core.checks import expect_sizes
from fmtorch.core.random import uniform
from fmtorch.core.streams import Stream
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.geometry.epipolar import inverse_root

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
