"""Batches of pairs with similar numbers of matches, drawn by seed and epoch, and collated with little padding."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Protocol, runtime_checkable

import torch
from torch.utils.data import DataLoader, Sampler

from fmtorch.jit.random import Stream, uniform
from fmtorch.training.augmentation import subset_size
from fmtorch.training.labelled import LabelledMatches, collate
from fmtorch.training.stored_matches import Draw, StoredMatches

MAX_PADDING = 0.2  # share of a batch's slots
_POOL = 8  # batches that are sorted by length together: more make lengths more similar and batches less random


@runtime_checkable
class Lengths(Protocol):
    """What a data set must tell of itself: its size, and about how many matches each pair will have in an epoch."""

    def __len__(self) -> int: ...

    def lengths(self, epoch: int) -> Sequence[float]: ...


class SimilarLengthBatches(Sampler[list[Draw]]):
    """Each pair once an epoch, in random batches of similar lengths: a ``batch_sampler`` for torch's DataLoader.

    Pairs are shuffled, sorted by length within pools of a few batches, and the batches shuffled. Every batch draws one
    number of matches that its pairs are cut to, so that padding is due to shorter pairs only; `collate_trimmed` bounds
    it. All is a function of (seed, epoch): after `set_epoch` the batches are those of an uninterrupted training, and
    `start` leaves out those that it has seen. The epoch travels with each item, so that workers of a DataLoader, also
    persistent ones, need not be told.

    Args:
        dataset: `MatchedPairs`. batch: pairs in a batch; the last one of an epoch may be smaller.
        seed: selects the batches. matches: range of the number of matches, uniform in its logarithm; None: no limit.
        rank, world_size: of this process in a distributed training; each has as many batches, where need be some of
            the first ones twice.

    Raises ValueError for a batch below 1, and for a rank that is not below world_size.
    """

    def __init__(
        self,
        dataset: Lengths,
        batch: int = 32,
        *,
        seed: int = 0,
        matches: Sequence[int] | None = (50, 4000),
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        if batch < 1:
            raise ValueError(f"batch is {batch}; it must be at least 1")
        if not 0 <= rank < world_size:
            raise ValueError(f"rank is {rank} of {world_size} processes; it must be from 0 to {world_size - 1}")
        self.dataset, self.batch, self.seed, self.matches = dataset, batch, seed, matches
        self.rank, self.world_size = rank, world_size
        self.epoch = self.start = 0

    def set_epoch(self, epoch: int, start: int = 0) -> None:
        """Choose the epoch, and how many of its batches (of this process) are left out at its start."""
        self.epoch, self.start = epoch, start

    def state_dict(self) -> dict[str, int]:
        """What `load_state_dict` needs."""
        return {"epoch": self.epoch, "start": self.start}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Go on where `state_dict` was taken."""
        self.set_epoch(state["epoch"], state["start"])

    def __len__(self) -> int:
        """Batches of this process in what is left of the epoch."""
        batches = -(-len(self.dataset) // self.batch)
        return max(-(-batches // self.world_size) - self.start, 0)

    def __iter__(self) -> Iterator[list[Draw]]:
        lengths = torch.tensor(self.dataset.lengths(self.epoch), dtype=torch.float64)
        order = self._shuffled(len(lengths), 0)
        pools = [pool[torch.argsort(lengths[pool], stable=True)] for pool in torch.split(order, _POOL * self.batch)]
        batches = [batch.tolist() for pool in pools for batch in torch.split(pool, self.batch)]
        batches = [batches[i] for i in self._shuffled(len(batches), 1).tolist()]
        sizes: list[int | None] = [None] * len(batches)
        if self.matches is not None:
            sizes = [subset_size(self.matches, u) for u in self._numbers(len(batches), 2).tolist()]
        drawn = [[Draw(i, self.epoch, size) for i in batch] for batch, size in zip(batches, sizes, strict=True)]
        rounds = -(-len(drawn) // self.world_size)
        everyone = list(itertools.islice(itertools.cycle(drawn), rounds * self.world_size)) if drawn else []
        yield from everyone[self.rank :: self.world_size][self.start :]

    def _numbers(self, n: int, purpose: int) -> torch.Tensor:
        key = torch.tensor([self.epoch * 3 + purpose])
        return uniform(self.seed, key, Stream.BATCHES, 0, n, 1)[0, :, 0]

    def _shuffled(self, n: int, purpose: int) -> torch.Tensor:
        return torch.argsort(self._numbers(n, purpose))


def collate_trimmed(items: Sequence[LabelledMatches], padding: float = MAX_PADDING) -> LabelledMatches:
    """`collate`, with the longest pairs cut so that at most `padding` of all slots are padding.

    The first matches of a pair are kept, a random subset of those that an `Augmentation` gives.
    Raises ValueError for an empty list.
    """
    counts = torch.tensor([int(item.correspondences.mask.sum()) for item in items])
    n = longest(counts, padding)
    return collate([item.compact().first(n) for item in items])


def longest(counts: torch.Tensor, padding: float) -> int:
    """The largest number of slots with at most `padding` of them empty, for pairs with so many matches each."""
    high = int(counts.max()) if len(counts) else 0
    low = int(counts.min()) if len(counts) else 0
    while low < high:  # the share of padding grows with the number of slots
        middle = (low + high + 1) // 2
        filled = int(counts.clamp(max=middle).sum())
        low, high = (middle, high) if filled >= (1 - padding) * len(counts) * middle else (low, middle - 1)
    return max(low, 1)


class EndlessBatches(Sampler[list[Draw]]):
    """Epoch after epoch of `batches`, from the batch of a given step on."""

    def __init__(self, batches: SimilarLengthBatches, step: int) -> None:
        self.batches, self.step = batches, step

    def __iter__(self) -> Iterator[list[Draw]]:
        self.batches.set_epoch(0)
        epoch, start = divmod(self.step, len(self.batches))
        while True:
            self.batches.set_epoch(epoch, start)
            yield from self.batches
            epoch, start = epoch + 1, 0


def training_batches(
    matches: StoredMatches, batch: int, seed: int, step: int, rank: int = 0, processes: int = 1, *, workers: int = 0
) -> DataLoader[LabelledMatches]:
    """A loader of augmented batches from `step` on, which never ends.

    Args:
        matches: with the augmentation of the training.
        batch: pairs in a batch of one process. seed: selects batches and augmentation. step: steps done so far.
        rank, processes: of a distributed training. workers: processes that load; 0: this one.
    """
    lengths = None if matches.augmentation is None else matches.augmentation.matches
    similar = SimilarLengthBatches(matches, batch, seed=seed, matches=lengths, rank=rank, world_size=processes)
    return DataLoader(
        matches, batch_sampler=EndlessBatches(similar, step), collate_fn=collate_trimmed, num_workers=workers,
        persistent_workers=workers > 0,
    )  # fmt: skip
