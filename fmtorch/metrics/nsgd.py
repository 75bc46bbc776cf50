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

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch.core.checks import checked, expect_sizes
from fmtorch.geometry.arithmetic import component_sum, sqrt, stable_sum
from fmtorch.geometry.epipolar import unit_largest
from fmtorch.jit.random import Stream, uniform

# Monte-Carlo means over virtual points: the part of a line inside an image, and draws until enough are accepted


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
    first, then, of pairs that need more, half as many, and each further time twice as many. Raises ValueError unless
    there is at least one sample.
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
            value = torch.nn.functional.pad(torch.where(taken, value, 0.0), (0, -draws % BLOCK))
            blocks = stable_sum(value.reshape(len(tile), value.shape[1] // BLOCK, BLOCK))
            total = total.index_put((tile,), component_sum(torch.cat([total[tile, None], blocks], 1), 1))
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
    def of(cls, line: list[Tensor], size: Float[Tensor, "*#batch 2"]) -> Chord:
        """Those of lines a, b, c of any scale, sign and direction, in coordinates from the centre of the image."""
        a, b, c = line
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
    pairs: Pairs, draws: Draws
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """Of each draw the mean distances in pixels in images 0 and 1 over its two halves, and whether it counts.

    A half is steps 1 and 2: a match (m, m') exact for one matrix, and its distances from the lines of the other.
    """
    F = from_centre(torch.stack([pairs.F_gt, pairs.F_est]), pairs.size1, BORDER)
    h, w = pairs.size0[..., None].unbind(-2)
    x, y, z = F.unbind(-1)
    of_shares = torch.stack([x * w, y * h, z + BORDER * (x + y)], -1)  # of shares of the sides of image 0
    chord = Chord.of(lines(of_shares, draws.x, draws.y), pairs.size1)
    x1, y1 = chord.at(draws.share)
    a1, b1, c1 = lines(of_shares.flip(0), draws.x, draws.y)
    a0, b0 = lines(F.flip(0).mT[..., :2, :], x1, y1)
    e = torch.addcmul(torch.addcmul(c1, a1, x1), b1, y1).abs()
    d0, d1 = (e * (torch.addcmul(a * a, b, b) + NORMAL_FLOOR**2).rsqrt() for a, b in ((a0, b0), (a1, b1)))
    return (d0[0] + d0[1]) / 2, (d1[0] + d1[1]) / 2, chord.hits.all(0)


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

    def draw(tile: Pairs, draws: Draws) -> tuple[Tensor, Tensor]:
        d0, d1, accepted = draw_distances(tile, draws)
        unit0, unit1 = unit(diagonal(tile.size0)), unit(diagonal(tile.size1))
        return (d0 / unit0[:, None] + d1 / unit1[:, None]) / 2, accepted

    total, count = sum_of_draws(pairs, draw, samples=samples, seed=seed)
    diagonal0, diagonal1 = diagonal(pairs.size0), diagonal(pairs.size1)
    worst = (diagonal0 / unit(diagonal0) + diagonal1 / unit(diagonal1)) / 2
    value = torch.where(count > 0, total / count.clamp(min=1), worst)
    return (torch.minimum(value, worst) if cap else value).reshape(shape).to(F_est.dtype)
