"""Monte-Carlo means over virtual points: the part of a line inside an image, and draws until enough are accepted.

Everything is elementwise or summed in a fixed order, so a pair's figure is bit-equal whatever the batch and the tile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Real
from torch import Tensor

from fmtorch.core.checks import expect_sizes
from fmtorch.core.random import uniform
from fmtorch.core.streams import Stream
from fmtorch.geometry.arithmetic import component_sum, sqrt, stable_sum

COLUMNS = 6  # random numbers of a draw: for each of its two halves a point (x, y) and a place on its line
BLOCK = 128  # draws summed together
TRIES = 10  # draws made at most, per accepted draw wanted
TILE = 1 << 14  # draws computed at a time, which fits a processor's cache
PARALLEL = 1e-12  # sine of the least angle between a line and a border: 1e-8 px over 10,000 px
NO_NORMAL = 1e-60  # squared length of a normal, for F of unit size, that is none


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


class Draws(NamedTuple):
    """Uniform numbers in [0, 1) of N draws of each pair, (2, B, N): of the first half of each draw and of the second.

    x, y: of a point in image 0. share: of a place on its line in image 1.
    """

    x: Tensor
    y: Tensor
    share: Tensor

    @classmethod
    def of(cls, seed: int, key: Int[Tensor, " b"], start: int, count: int) -> Draws:
        """Those of the draws start .. start + count - 1."""
        numbers = uniform(seed, key, Stream.METRIC, start, count, COLUMNS)
        return cls(*numbers.reshape(*numbers.shape[:2], 2, 3).permute(3, 2, 0, 1).contiguous().unbind(0))


Draw = Callable[[Pairs, Draws], tuple[Tensor, Tensor]]


def sum_of_draws(pairs: Pairs, draw: Draw, *, samples: int, seed: int) -> tuple[Float[Tensor, " b"], Int[Tensor, " b"]]:
    """Sum of the first `samples` accepted draws of each pair, and how many there are among 10 x `samples` tries.

    `draw` maps pairs and their draws to values and accepted flags, both (b, draws). As many draws as samples are made
    first, then, of pairs that need more, half as many, and each further time twice as many. Raises ValueError unless there
    is at least one sample.
    """
    if samples < 1:
        raise ValueError(f"samples is {samples}; it must be at least 1")
    total, count = torch.zeros_like(pairs.size0[:, 0]), torch.zeros_like(pairs.key)
    active = torch.arange(len(count), device=count.device)
    start, tries = 0, TRIES * samples
    more = first = -(-samples // BLOCK) * BLOCK
    while start == 0 or (start < tries and len(active)):
        draws = min(more, tries - start)
        for tile in torch.split(active, max(1, TILE // draws)):
            current = pairs.take(tile)
            value, accepted = draw(current, Draws.of(seed, current.key, start, draws))
            taken = accepted & (count[tile, None] + accepted.cumsum(-1) <= samples)
            blocks = torch.nn.functional.pad(torch.where(taken, value, 0.0), (0, -draws % BLOCK)).unflatten(
                1, (-1, BLOCK)
            )
            sums = torch.cat([total[tile, None], stable_sum(blocks)], 1)
            total = total.index_put((tile,), component_sum(sums, 1))
            count = count.index_add(0, tile, taken.sum(-1))
        active = active[count[active] < samples]
        more = 2 * more if start else -(-first // (2 * BLOCK)) * BLOCK
        start += draws
    return total, count


def from_centre(F: Float[Tensor, "*#batch 3 3"], size1: Float[Tensor, "*#batch 2"], origin: float) -> Tensor:
    """Matrices whose lines are in coordinates from the centre of image 1, the rectangle (origin, origin + size)."""
    y, x = (size1 / 2 + origin)[..., None].unbind(-2)
    return torch.cat([F[..., :2, :], (F[..., 2, :] + F[..., 0, :] * x + F[..., 1, :] * y)[..., None, :]], -2)


def lines(
    F: Float[Tensor, "*batch rows 3"], x: Float[Tensor, "*batch n"], y: Float[Tensor, "*batch n"]
) -> list[Tensor]:
    """The components of F (x, y, 1)."""
    return [torch.addcmul(x * row[..., 0, None] + row[..., 2, None], y, row[..., 1, None]) for row in F.unbind(-2)]


class Chord(NamedTuple):
    """The part of each line inside an image: of the points (x + t b, y - t a) those with t from low to high.

    hits: whether there is one; where there is none the others are finite all the same.
    """

    x: Tensor
    y: Tensor
    a: Tensor
    b: Tensor
    low: Tensor
    high: Tensor
    hits: Tensor

    @classmethod
    def of(cls, a: Tensor, b: Tensor, c: Tensor, size: Float[Tensor, "*#batch 2"]) -> Chord:
        """Those of lines of any scale, sign and direction, in coordinates from the centre of the image."""
        half_h, half_w = (size / 2)[..., None, :].unbind(-1)
        squared = torch.addcmul(a * a, b, b)
        # The sign makes t run from left to right, on a vertical line downwards.
        scale = torch.copysign(squared.clamp_min(NO_NORMAL).rsqrt(), b - PARALLEL * a)
        a, b, c = a * scale, b * scale, c * scale
        x, y = -a * c, -b * c
        middle_x, reach_x = _interval(-x, b, half_w)
        middle_y, reach_y = _interval(y, a, half_h)
        low = torch.maximum(middle_x - reach_x, middle_y - reach_y)
        high = torch.minimum(middle_x + reach_x, middle_y + reach_y)
        return cls(x, y, a, b, low, high, (low < high) & (squared > NO_NORMAL))

    def at(self, share: Tensor) -> tuple[Tensor, Tensor]:
        """x and y at a share of the way from the left end, or the upper one of a vertical line."""
        t = torch.addcmul(self.low, share, self.high - self.low)
        return torch.addcmul(self.x, t, self.b), torch.addcmul(self.y, t, self.a, value=-1)


def _interval(offset: Tensor, direction: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Middle and half-length of the interval where |t direction - offset| <= half."""
    size = direction.abs().clamp_min(PARALLEL)
    return offset / torch.copysign(size, direction), half / size
