"""Batches: every pair once an epoch, similar lengths, little padding, the same after a restart, shared out to ranks."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from fmtorch.training import Draw, LabelledMatches, SimilarLengthBatches, StoredMatches, collate, collate_trimmed
from tests.training.conftest import exact


class Pairs(StoredMatches):
    """Pairs of which only the lengths are known, as various as those of the rendered scenes."""

    def __init__(self, n: int = 300) -> None:
        self.counts = np.random.default_rng(0).lognormal(6, 0.8, n).astype(int) + 20

    def __len__(self) -> int:
        return len(self.counts)

    def lengths(self, epoch: int) -> Sequence[float]:
        return self.counts.tolist()


def padding(m: LabelledMatches) -> float:
    return 1 - float(m.correspondences.mask.double().mean())


def test_every_pair_comes_once_an_epoch_in_other_batches_each_time() -> None:
    batches = SimilarLengthBatches(Pairs(), 32, seed=1)
    epochs = []
    for epoch in range(2):
        batches.set_epoch(epoch)
        drawn = list(batches)
        assert len(drawn) == len(batches) == 10
        assert sorted(d.pair for batch in drawn for d in batch) == list(range(300))
        assert {d.epoch for batch in drawn for d in batch} == {epoch}
        assert all(len({d.matches for d in batch}) == 1 for batch in drawn)
        assert sorted(map(len, drawn)) == [12, *[32] * 9]
        epochs.append([frozenset(d.pair for d in batch) for batch in drawn])
    assert not set(epochs[0]) & set(epochs[1])
    sizes = [batch[0].matches for batch in drawn]
    assert len(set(sizes)) > 5
    assert all(50 <= size <= 4000 for size in sizes)


def test_batches_are_a_function_of_seed_and_epoch_and_go_on_where_they_stopped() -> None:
    batches = SimilarLengthBatches(Pairs(), 16, seed=2)
    batches.set_epoch(7)
    epoch = list(batches)
    again = SimilarLengthBatches(Pairs(), 16, seed=2)
    again.set_epoch(7, start=5)
    state = again.state_dict()
    fresh = SimilarLengthBatches(Pairs(), 16, seed=2)
    fresh.load_state_dict(state)
    assert list(again) == list(fresh) == epoch[5:]
    assert len(fresh) == len(epoch) - 5
    other = SimilarLengthBatches(Pairs(), 16, seed=3)
    other.set_epoch(7)
    assert list(other) != epoch


@pytest.mark.parametrize("world_size", [2, 3, 4])
def test_ranks_share_the_epoch_out_and_have_as_many_batches(world_size: int) -> None:
    ranks = [list(SimilarLengthBatches(Pairs(), 32, rank=r, world_size=world_size)) for r in range(world_size)]
    assert len({len(drawn) for drawn in ranks}) == 1
    single = list(SimilarLengthBatches(Pairs(), 32))
    shared = [batch for drawn in zip(*ranks, strict=True) for batch in drawn]
    assert shared[: len(single)] == single
    assert shared[len(single) :] == single[: len(shared) - len(single)]
    sampler = SimilarLengthBatches(Pairs(), 32, rank=world_size - 1, world_size=world_size)
    assert len(sampler) == len(ranks[-1])


def test_trimmed_collation_keeps_real_matches_and_the_bound() -> None:
    items = [exact(seed, n=n) for seed, n in enumerate((20, 150, 160, 170, 400))]
    assert padding(collate(items)) > 0.5
    batch = collate_trimmed(items)
    assert padding(batch) <= 0.2
    for i, item in enumerate(items):
        mine = batch[i].compact()
        n = mine.label.shape[1]
        assert torch.equal(mine.label, item.label[:, :n])
        assert torch.equal(mine.correspondences.x0, item.correspondences.x0[:, :n])
    assert padding(collate_trimmed(items, padding=0.0)) == 0
    with pytest.raises(ValueError, match="at least one"):
        collate_trimmed([])


def test_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="batch is 0"):
        SimilarLengthBatches(Pairs(), 0)
    with pytest.raises(ValueError, match="rank is 2 of 2"):
        SimilarLengthBatches(Pairs(), rank=2, world_size=2)
    assert Draw(3) == (3, 0, None)
