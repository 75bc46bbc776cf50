"""Which matches a minimal sample holds: a stateless function of (seed, pair key, draw)."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Int
from torch import Tensor

from fmtorch.core import random
from fmtorch.core.random import Stream
from fmtorch.estimators.pairs import NormalizedPairs

_RANDOM_BITS = 32
_TOTAL_BITS = 30  # cumulative weights stay below 2^30, so that 32 random bits times a total fit an int64


@runtime_checkable
class Sampler(Protocol):
    """Draws minimal samples without replacement."""

    def draw(self, pairs: NormalizedPairs, start: int, count: int, size: int) -> Int[Tensor, "size p count"]:
        """Indices of the `size` matches in each of the draws start .. start + count - 1."""
        ...

    def weight(self, pairs: NormalizedPairs) -> Int[Tensor, "p n"]:
        """How likely each match is to be drawn, relative to the others, for the stopping rule."""
        ...


class Uniform:
    """Every set of matches is equally likely."""

    def weight(self, pairs: NormalizedPairs) -> Int[Tensor, "p n"]:
        """One for each match."""
        return pairs.mask.to(torch.int64)

    def draw(self, pairs: NormalizedPairs, start: int, count: int, size: int) -> Int[Tensor, "size p count"]:
        """As `Sampler.draw`."""
        return torch.stack(_without_replacement(pairs, pairs.count[:, None].expand(-1, count), None, start, size))


class Prosac:
    """PROSAC (Chum & Matas, CVPR 2005): samples from the best matches first, from all of them in the end.

    Matches are ranked by quality, smaller first, or by prior where there is no quality; without either all sets are
    equally likely, since the order of matches means nothing. Draw t takes the n(t)-th match and the others from those
    before it, n(t) growing as the paper's equation 3 says for T_N draws.
    """

    GROWTH = 200_000  # T_N: after so many draws PROSAC is RANSAC; the paper's value

    def weight(self, pairs: NormalizedPairs) -> Int[Tensor, "p n"]:
        """One for each match."""
        return pairs.mask.to(torch.int64)

    def growth(self, pairs: NormalizedPairs, size: int) -> Int[Tensor, "p n"]:
        """T'_n for n = 1 .. N: the last draw whose sample comes from the first n matches (equation 4)."""
        n = torch.arange(1, pairs.mask.shape[1] + 1, device=pairs.mask.device, dtype=torch.float64)
        total = pairs.count[:, None].to(torch.float64)
        draws = torch.full_like(total, self.GROWTH) * torch.ones_like(n)
        for i in range(size):
            draws = draws * ((n - i).clamp_min(0) / (total - i).clamp_min(1))
        steps = torch.ceil(draws.diff(dim=1)).to(torch.int64)
        steps = torch.nn.functional.pad(steps, (1, 0))
        return torch.where(n < size, 0, torch.where(n == size, 1, steps)).cumsum(1)

    def draw(self, pairs: NormalizedPairs, start: int, count: int, size: int) -> Int[Tensor, "size p count"]:
        """As `Sampler.draw`."""
        rank = pairs.quality if pairs.quality is not None else pairs.prior
        if rank is None:
            return Uniform().draw(pairs, start, count, size)
        table = pairs.once(f"growth of samples of {size}", lambda: self.growth(pairs, size))
        t = torch.arange(start + 1, start + count + 1, device=table.device).expand(len(table), -1)
        newest = torch.minimum(torch.searchsorted(table, t.contiguous()), pairs.count[:, None] - 1)
        others = _without_replacement(pairs, newest, None, start, size - 1)
        sample = torch.stack([*others, newest])
        worst = torch.where(pairs.mask, rank if pairs.quality is not None else -rank, torch.inf)
        order = pairs.once("best matches first", lambda: torch.sort(worst, dim=1, stable=True).indices)
        return order.expand(size, -1, -1).gather(2, sample)


class PriorWeighted:
    """Matches drawn in proportion to their prior P(inlier); uniform where there is none."""

    uses_prior = True

    def weight(self, pairs: NormalizedPairs) -> Int[Tensor, "p n"]:
        """The priors, quantised so that their sums are exact, the same on any device and under any padding."""
        if pairs.prior is None:
            return pairs.mask.to(torch.int64)
        weight = (pairs.prior * largest_weight(pairs.mask.shape[1])).round().to(torch.int64).clamp_min(1)
        return torch.where(pairs.mask, weight, 0)

    def draw(self, pairs: NormalizedPairs, start: int, count: int, size: int) -> Int[Tensor, "size p count"]:
        """As `Sampler.draw`."""
        table = pairs.once("cumulative priors", lambda: self.weight(pairs).cumsum(-1))
        return torch.stack(_without_replacement(pairs, table[:, -1:].expand(-1, count), table, start, size))


def largest_weight(slots: int) -> int:
    """The weight of a prior of one in a bucket of so many slots."""
    return 1 << (_TOTAL_BITS - (slots - 1).bit_length())


def _without_replacement(
    pairs: NormalizedPairs, total: Int[Tensor, "p count"], table: Tensor | None, start: int, size: int
) -> list[Tensor]:
    """Weighted sampling without replacement: intervals already drawn are cut out of [0, total).

    A position is drawn in what is left and pushed past every drawn interval in ascending order; the table tells whose
    interval it falls in. Without a table every interval has length one.
    """
    random_bits = random.bits(pairs.seed, pairs.key, Stream.SAMPLING, start, total.shape[1], size) >> (
        63 - _RANDOM_BITS
    )
    left = total
    if table is not None:
        starts = torch.nn.functional.pad(table, (1, -1))
        weight = table - starts
    begins, shortened, lengths = random_bits.new_empty(3, size, *random_bits.shape[:2]).unbind(0)
    drawn: list[Tensor] = []
    for j in range(size):
        # shortened: where the intervals drawn so far begin when those before them are cut out.
        position = (random_bits[..., j] * left) >> _RANDOM_BITS
        position = position + (lengths[:j] * (position >= shortened[:j])).sum(0)
        if table is None:
            index, begin, length = position, position, torch.ones_like(position)
        else:
            index = torch.searchsorted(table, position, right=True)
            begin, length = starts.gather(1, index), weight.gather(1, index)
        drawn.append(index)
        left = left - length
        before = begins[:j] < begin
        shortened[:j] -= length * ~before
        begins[j], lengths[j], shortened[j] = begin, length, begin - (lengths[:j] * before).sum(0)
    return drawn


def with_replacement(bits: Int[Tensor, "p *sets draws"], weight: Int[Tensor, "p *sets n"]) -> Tensor:
    """Indices drawn in proportion to the weights, integers whose sum is below 2^31, by 63 random bits each."""
    table = weight.cumsum(-1)
    position = ((bits >> 31) * table[..., -1:]) >> 32
    return torch.searchsorted(table, position, right=True).clamp_max_(weight.shape[-1] - 1)
