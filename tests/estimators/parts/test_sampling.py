"""Minimal samples: those of the definition, number by number; distinct, and distributed as they should be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from fmtorch.core.streams import Stream
from fmtorch.core.types import Correspondences, collate
from fmtorch.estimators.pair import bucket
from fmtorch.estimators.parts.sampling import PriorWeighted, Prosac, Uniform, largest_weight
from tests.estimators.pairs import pair_of
from tests.laws import scene, with_padding
from tests.reference import sampling as reference

SAMPLERS = {"uniform": Uniform(), "prior": PriorWeighted(), "prosac": Prosac()}
SEED = 3


def matches(count: int, prior: str = "given") -> Correspondences:
    c = scene(count, count)
    if prior == "none":
        return c.replace(prior=None)
    if prior == "zero":
        return c.replace(prior=torch.zeros_like(c.x0[..., 0]))
    if prior == "one certain":
        return c.replace(prior=(torch.arange(count) == count // 2).float()[None])
    return c


@pytest.mark.parametrize("prior", ["given", "none", "zero", "one certain"])
@pytest.mark.parametrize("size", [4, 5, 7, 8])
@pytest.mark.parametrize("count", [8, 9, 40, 700])
def test_weighted_samples(count: int, size: int, prior: str) -> None:
    pair = pair_of(matches(count, prior), SEED)
    for sampler in (PriorWeighted(), Uniform()):
        weights = sampler.weight(pair).tolist()
        for start in (0, 700):
            drawn = sampler.draw(pair, start, 12, size)
            expected = [
                reference.weighted_sample(weights, size, SEED, pair.key, Stream.SAMPLING, start + d) for d in range(12)
            ]
            np.testing.assert_array_equal(drawn.T, expected)


def test_weights_are_quantised_priors() -> None:
    pair = pair_of(matches(40), SEED)
    assert pair.prior is not None
    largest = largest_weight(bucket(40))
    expected = [max(round(p * largest), 1) for p in pair.prior.tolist()]
    assert PriorWeighted().weight(pair).tolist() == expected
    assert 40 * largest <= 1 << 30
    assert PriorWeighted().weight(pair_of(matches(40, "none"))).tolist() == [1] * 40


@pytest.mark.parametrize("count", [8, 40, 300])
def test_samples_of_prosac(count: int) -> None:
    pair = pair_of(matches(count), SEED)
    assert pair.quality is not None
    order = np.argsort(pair.quality, kind="stable").tolist()
    for size in (4, 5, 7, 8):
        growth = reference.prosac_growth(count, size, Prosac.GROWTH)
        np.testing.assert_array_equal(Prosac().growth(count, size), growth)
        for start in (0, 5000, 250_000):
            for d, sample in enumerate(Prosac().draw(pair, start, 8, size).T.tolist()):
                newest = min(sum(last < start + d + 1 for last in growth), count - 1)
                draw = start + d
                expected = reference.prosac_sample(order, newest, size, SEED, pair.key, Stream.SAMPLING, draw)
                if draw >= growth[-1]:  # RANSAC from here on
                    expected = reference.weighted_sample([1] * count, size, SEED, pair.key, Stream.SAMPLING, draw)
                assert sample == expected


def test_without_a_rank_the_order_of_matches_means_nothing() -> None:
    """Else two thousand draws would come from the first half of the matches alone, which is a part of the image."""
    pair = pair_of(matches(100).replace(quality=None, prior=None))
    np.testing.assert_array_equal(Prosac().draw(pair, 100, 300, 7), Uniform().draw(pair, 100, 300, 7))
    by_prior = pair_of(matches(100).replace(quality=None))
    assert by_prior.prior is not None
    likely = np.argsort(-by_prior.prior, kind="stable")[:7]
    assert set(Prosac().draw(by_prior, 0, 1, 7)[:, 0]) == set(likely)


@pytest.mark.parametrize("name", SAMPLERS)
@pytest.mark.parametrize("count", [8, 9, 40, 5000])
def test_samples_hold_distinct_matches(name: str, count: int) -> None:
    sample = np.sort(SAMPLERS[name].draw(pair_of(matches(count)), 0, 3000, 8), axis=0)
    assert (np.diff(sample, axis=0) > 0).all()
    assert sample.min() >= 0
    assert sample.max() < count


@pytest.mark.parametrize("name", SAMPLERS)
def test_samples_are_a_function_of_seed_key_and_draw(name: str) -> None:
    sampler: Any = SAMPLERS[name]
    alone = sampler.draw(pair_of(scene(1, 150)), 0, 400, 7)
    np.testing.assert_array_equal(alone[:, 100:], sampler.draw(pair_of(scene(1, 150)), 100, 300, 7))
    padded = with_padding(collate([scene(1, 150), scene(2, 170)]), np.random.default_rng(0), 1e9)
    np.testing.assert_array_equal(sampler.draw(pair_of(padded), 0, 400, 7), alone)
    assert not np.array_equal(sampler.draw(pair_of(scene(1, 150), seed=1), 0, 400, 7), alone)


def test_uniform_samples_are_uniform() -> None:
    # Each of 12 matches is in a sample of 8 with probability 2/3; chi-square over the 12 counts at 1e-4.
    sample = Uniform().draw(pair_of(matches(12)), 0, 20000, 8)
    assert stats.chisquare(np.bincount(sample.ravel(), minlength=12)).pvalue > 1e-4
    assert stats.chisquare(np.bincount(sample[0], minlength=12)).pvalue > 1e-4


def test_prior_samples_follow_the_prior() -> None:
    pair = pair_of(matches(30))
    assert pair.prior is not None
    p = pair.prior / pair.prior.sum()
    first, second = PriorWeighted().draw(pair, 0, 50000, 2)
    assert stats.chisquare(np.bincount(first, minlength=30), 50000 * p).pvalue > 1e-4
    # Without replacement: the second is j with probability sum_i p_i p_j / (1 - p_i), i != j.
    expected = np.array([sum(p[i] * p[j] / (1 - p[i]) for i in range(30) if i != j) for j in range(30)])
    assert stats.chisquare(np.bincount(second, minlength=30), 50000 * expected).pvalue > 1e-4
