"""Minimal samples: those of the definitions, distributed as they should be, and the same in any batch."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from fmtorch.core import Correspondences, collate
from fmtorch.estimators import Pair, PriorWeighted, Prosac, Sampler, Uniform
from fmtorch.estimators.sampling import largest_weight
from fmtorch.jit.random import Stream
from tests.estimators.pairs import known, pair_of
from tests.laws import scene, with_padding
from tests.reference import ransac as reference
from tests.reference.random import number

SAMPLERS = [Uniform(), PriorWeighted(), Prosac()]
SEED = 3


def pair(count: int, prior: str = "given") -> Pair:
    c = known(count)
    index = torch.arange(count)[None]
    priors = {
        "none": None, "zero": torch.zeros(1, count), "one certain": (index == count // 2).float(),
        "small": torch.logspace(-12, 0, count)[None], "given": c.prior,
    }  # fmt: skip
    return pair_of(c.replace(prior=priors[prior]), seed=SEED)


def numbers(pair: Pair, draw: int, columns: int) -> list[int]:
    return [number(pair.seed, pair.key, Stream.SAMPLING, draw, j, columns) for j in range(columns)]


@pytest.mark.parametrize("prior", ["given", "none", "zero", "one certain", "small"])
@pytest.mark.parametrize("size", [4, 5, 7, 8])
@pytest.mark.parametrize("count", [8, 9, 20, 40, 150, 700])
def test_samples_by_weight_are_those_of_the_definition(count: int, size: int, prior: str) -> None:
    matches = pair(count, prior)
    ones = [1] * count
    weights = (
        ones if matches.prior is None else reference.quantised(matches.prior.tolist(), largest_weight(matches.bucket))
    )
    for sampler, expected in ((PriorWeighted(), weights), (Uniform(), ones)):
        assert sampler.weight(matches).tolist() == expected
        assert sum(expected) <= 1 << 30
        for start, draws in ((0, 20), (700, 11)):
            sample = sampler.draw(matches, start, draws, size)
            assert sample.dtype == np.int64
            assert sample.T.tolist() == [
                reference.weighted_sample(expected, numbers(matches, start + d, size)) for d in range(draws)
            ]


@pytest.mark.parametrize("size", [4, 5, 7, 8])
@pytest.mark.parametrize("count", [8, 9, 20, 40, 700])
def test_samples_of_prosac_are_those_of_the_definition(count: int, size: int) -> None:
    matches, sampler = pair(count), Prosac()
    exact, grown = reference.prosac_growth(count, size, sampler.GROWTH)
    table = sampler.growth(count, size).tolist()
    for n in range(1, count):  # a whole number that rounding has put above itself is rounded up to the next
        excess = table[n] - table[n - 1] - (exact[n] - exact[n - 1])
        assert excess == 0 or (excess == 1 and grown[n].denominator == 1), n
    best = np.argsort(matches.ambiguity, kind="stable")
    for start in (0, table[-1] // 2, max(table[-1] - 10, 0)):
        draws = min(20, table[-1] - start)
        expected = [
            reference.prosac_sample(table, start + d + 1, numbers(matches, start + d, size - 1)) for d in range(draws)
        ]
        np.testing.assert_array_equal(sampler.draw(matches, start, draws, size).T, best[expected])


def test_prosac_ranks_by_prior_where_there_is_no_quality() -> None:
    matches = pair_of(scene(1, 100).replace(ratio=None))
    rank = np.argsort(np.argsort(-matches.prior, kind="stable"))
    sample = rank[Prosac().draw(matches, 0, 300, 7)]
    assert sorted(sample[:, 0].tolist()) == list(range(7))
    assert (np.diff(sample.max(0)) >= 0).all()


def test_prosac_is_uniform_after_its_growth_and_where_nothing_is_ranked() -> None:
    """Without a rank the order of matches means nothing: the first half may be a part of the image."""
    matches = pair(20)
    end = int(Prosac().growth(20, 7)[-1])
    assert (Prosac().draw(matches, end - 1, 1, 7) == np.argsort(matches.ambiguity)[-1]).any()
    across = Prosac().draw(matches, end - 30, 60, 7)
    np.testing.assert_array_equal(across[:, :30], Prosac().draw(matches, end - 30, 30, 7))
    np.testing.assert_array_equal(across[:, 30:], Uniform().draw(matches, end, 30, 7))
    nothing = pair_of(scene(1, 100).replace(ratio=None, prior=None))
    np.testing.assert_array_equal(Prosac().draw(nothing, 100, 300, 7), Uniform().draw(nothing, 100, 300, 7))


@pytest.mark.parametrize("key", [0, 1, -1, 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("seed", [0, -3, 2**62])
def test_samples_of_any_key_and_seed(seed: int, key: int) -> None:
    matches = pair_of(scene(0, 30).replace(key=torch.tensor([key])), seed=seed)
    expected = [reference.weighted_sample([1] * 30, numbers(matches, d, 7)) for d in range(20)]
    assert Uniform().draw(matches, 0, 20, 7).T.tolist() == expected


@pytest.mark.parametrize("sampler", [Uniform(), PriorWeighted()])
def test_samples_follow_the_prior(sampler: Any) -> None:
    """Chi-square of how often a match is the first, and the second of a sample, at 1e-4."""
    matches, draws = pair(30), 50_000
    p = sampler.weight(matches) / sampler.weight(matches).sum()
    sample = sampler.draw(matches, 0, draws, 2)
    # Without replacement: the second is j with probability sum_i p_i p_j / (1 - p_i), i != j.
    second = [sum(p[i] * p[j] / (1 - p[i]) for i in range(30) if i != j) for j in range(30)]
    for drawn, expected in zip(sample, (p, np.array(second)), strict=True):
        assert stats.chisquare(np.bincount(drawn, minlength=30), draws * expected).pvalue > 1e-4


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_samples_are_a_function_of_seed_key_and_draw(sampler: Sampler) -> None:
    def drawn(c: Correspondences, i: int = 0, start: int = 0, count: int = 400, seed: int = 0) -> Any:
        return sampler.draw(pair_of(c, seed, i), start, count, 7)

    alone = drawn(scene(1, 150))
    ordered = np.sort(alone, 0)
    assert (ordered[1:] > ordered[:-1]).all()
    np.testing.assert_array_equal(drawn(scene(1, 150), start=100, count=300), alone[:, 100:])
    batch = with_padding(collate([scene(2, 250), scene(1, 150)]), np.random.default_rng(0), float("nan"))
    np.testing.assert_array_equal(drawn(batch, 1), alone)
    assert not np.array_equal(drawn(scene(1, 150), seed=1), alone)
    assert not np.array_equal(drawn(scene(1, 150).replace(key=torch.tensor([5]))), alone)
