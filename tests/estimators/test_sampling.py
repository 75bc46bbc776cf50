"""Minimal samples: distinct, distributed as they should be, and the same in any batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from fmtorch.core.types import collate
from fmtorch.estimators.pairs import NormalizedPairs, bucket, normalized_pairs
from fmtorch.estimators.sampling import PriorWeighted, Prosac, Sampler, Uniform
from tests.laws import scene, with_padding

SAMPLERS = [Uniform(), PriorWeighted(), Prosac()]
NAMES = ["uniform", "prior", "prosac"]


def _pairs(count: int, seed: int = 0) -> NormalizedPairs:
    return normalized_pairs(scene(1, count), seed, 8)[0][0]


def _draw(sampler: Sampler, pairs: NormalizedPairs, start: int, count: int, size: int) -> torch.Tensor:
    return sampler.draw(pairs, start, count, size)


@pytest.mark.parametrize("sampler", SAMPLERS, ids=NAMES)
@pytest.mark.parametrize("count", [8, 9, 40, 700])
def test_samples_hold_distinct_live_matches(sampler: Sampler, count: int) -> None:
    sample = _draw(sampler, _pairs(count), 0, 3000, 8)
    ordered = sample.sort(0).values
    assert bool((ordered[1:] > ordered[:-1]).all())
    assert int(sample.min()) >= 0
    assert int(sample.max()) < count


def test_uniform_samples_are_uniform() -> None:
    # Each of 12 matches is in a sample of 8 with probability 2/3; chi-square over the 12 counts at 1e-4.
    counts = np.bincount(_draw(Uniform(), _pairs(12), 0, 20000, 8).flatten().numpy(), minlength=12)
    assert stats.chisquare(counts).pvalue > 1e-4
    first = np.bincount(_draw(Uniform(), _pairs(12), 0, 20000, 8)[0].flatten().numpy(), minlength=12)
    assert stats.chisquare(first).pvalue > 1e-4


def test_prior_samples_follow_the_prior() -> None:
    pairs = _pairs(30)
    assert pairs.prior is not None
    prior = pairs.prior[0, :30].numpy()
    first = np.bincount(_draw(PriorWeighted(), pairs, 0, 50000, 2)[0].flatten().numpy(), minlength=30)
    assert stats.chisquare(first, 50000 * prior / prior.sum()).pvalue > 1e-4
    # Without replacement: the second is j with probability sum_i p_i p_j / (1 - p_i), i != j.
    p = prior / prior.sum()
    second = np.array([sum(p[i] * p[j] / (1 - p[i]) for i in range(30) if i != j) for j in range(30)])
    observed = np.bincount(_draw(PriorWeighted(), pairs, 0, 50000, 2)[1].flatten().numpy(), minlength=30)
    assert stats.chisquare(observed, 50000 * second).pvalue > 1e-4


@pytest.mark.parametrize("sampler", SAMPLERS, ids=NAMES)
def test_samples_are_a_function_of_seed_key_and_draw(sampler: Sampler) -> None:
    alone = _draw(sampler, _pairs(150), 0, 400, 7)
    later = _draw(sampler, _pairs(150), 100, 300, 7)
    assert torch.equal(alone[:, :, 100:], later)
    batch = normalized_pairs(
        with_padding(collate([scene(2, 150), scene(1, 150)]), np.random.default_rng(0), 1e9), 0, 8
    )[0][0]
    assert torch.equal(_draw(sampler, batch, 0, 400, 7)[:, 1:], alone)
    assert not torch.equal(_draw(sampler, _pairs(150, seed=1), 0, 400, 7), alone)


@pytest.mark.parametrize(
    ("count", "size"), [(1, 128), (128, 128), (129, 192), (192, 192), (193, 256), (760, 768), (769, 1024)]
)
def test_buckets(count: int, size: int) -> None:
    assert bucket(count) == size


def test_prosac_grows_as_published() -> None:
    pairs = _pairs(60)
    table = Prosac().growth(pairs, 7)[0].tolist()
    # Chum & Matas 2005, equations 3 and 4, term by term.
    expected, T = 1, Prosac.GROWTH * np.prod([(7 - i) / (60 - i) for i in range(7)])
    assert table[6] == 1
    for n in range(8, 61):
        T_next = T * n / (n - 7)
        expected += int(np.ceil(round(T_next - T, 9)))
        assert table[n - 1] == expected
        T = T_next


def test_prosac_draws_the_best_first() -> None:
    pairs = _pairs(100)
    assert pairs.quality is not None
    rank = pairs.quality[0, :100].argsort(stable=True).argsort()
    sample = rank[_draw(Prosac(), pairs, 0, 300, 7)[:, 0]]
    assert sorted(sample[:, 0].tolist()) == list(range(7))
    assert bool((sample.amax(0).diff() >= 0).all())


def test_without_a_rank_the_order_of_matches_means_nothing() -> None:
    """Else two thousand draws would come from the first half of the matches alone, which is a part of the image."""
    pairs = normalized_pairs(scene(1, 100).replace(quality=None, prior=None), 0, 8)[0][0]
    assert torch.equal(_draw(Prosac(), pairs, 100, 300, 7), _draw(Uniform(), pairs, 100, 300, 7))
