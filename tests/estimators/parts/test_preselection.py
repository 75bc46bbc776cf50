"""A round's models compared on few matches first: which matches, which models, and the scores of those that pass."""

from __future__ import annotations

import numpy as np
import pytest

from fmtorch.core.streams import Stream
from fmtorch.estimators.families.fundamental import SevenPoint
from fmtorch.estimators.options import Preselect
from fmtorch.estimators.pair import Pair
from fmtorch.estimators.parts.preselection import Preselection, best
from fmtorch.estimators.parts.sampling import Uniform
from fmtorch.estimators.parts.saturated import SaturatedGains
from fmtorch.estimators.parts.scores import Msac
from tests.estimators.pairs import pair_of
from tests.laws import scene
from tests.reference import sampling as reference


def hypotheses(pair: Pair, count: int = 100) -> np.ndarray:
    return SevenPoint().solve(pair, Uniform().draw(pair, 0, count, 7), 0).F


@pytest.mark.parametrize(("m", "k"), [(1, 1), (30, 7), (300, 300), (1000, 999), (5, 2)])
def test_the_best_scores_and_of_equals_the_first(m: int, k: int) -> None:
    score = np.random.default_rng(m).integers(0, 9, m).astype(float)
    out = np.empty(k, np.int64)
    best(score, out)
    expected = sorted(sorted(range(m), key=lambda i: (-score[i], i))[:k])
    assert out.tolist() == expected


@pytest.mark.parametrize("count", [256, 300, 2000])
def test_the_subset_of_a_score_that_knows_no_prior(count: int) -> None:
    pair = pair_of(scene(1, count), 5)
    subset = Preselection(Msac(1.0), Preselect(matches=64, survivors=9)).subset(pair)
    assert subset is not None
    expected = reference.shuffled(range(count), 5, pair.key, Stream.PRESELECTION)[:64]
    np.testing.assert_array_equal(subset.points, pair.points[:, expected])


def test_the_subset_of_a_score_that_weighs_by_the_prior() -> None:
    c = scene(1, 300)
    assert c.prior is not None
    c.prior[0, :200] = 0
    pair = pair_of(c, 5)
    assert pair.prior is not None
    subset = Preselection(SaturatedGains(1.0), Preselect(matches=128, survivors=9)).subset(pair)
    assert subset is not None
    expected = sorted(reference.by_priority(pair.prior.tolist(), 5, pair.key, Stream.PRESELECTION)[:128])
    np.testing.assert_array_equal(subset.points, pair.points[:, expected])
    np.testing.assert_array_equal(subset.match_weight, pair.prior[expected] > 0)  # each counts as one
    assert (pair.match_weight == pair.prior).all()  # the pair itself is as it was


def test_no_subset_of_few_matches() -> None:
    assert Preselection(Msac(1.0), Preselect(matches=128)).subset(pair_of(scene(1, 190))) is None
    assert Preselection(Msac(1.0), None).subset(pair_of(scene(1, 1000))) is None


def test_survivors_are_the_best_on_few_matches_with_their_scores_on_all() -> None:
    pair, score = pair_of(scene(1, 300)), Msac(1.0)
    F = hypotheses(pair)
    preselection = Preselection(score, Preselect(matches=64, survivors=20))
    which, scores = preselection(F, pair)
    subset = preselection.subset(pair)
    assert subset is not None
    every = np.arange(len(F))
    first = score(F, every, subset)
    assert which.tolist() == sorted(sorted(every, key=lambda i: (-first[i], i))[:20])
    np.testing.assert_array_equal(scores, score(F, every, pair)[which])


@pytest.mark.parametrize("options", [None, Preselect(matches=64, survivors=10_000)])
def test_all_survive_where_there_are_not_more(options: Preselect | None) -> None:
    pair, score = pair_of(scene(1, 300)), Msac(1.0)
    F = hypotheses(pair, 30)
    which, scores = Preselection(score, options)(F, pair)
    np.testing.assert_array_equal(which, np.arange(len(F)))
    np.testing.assert_array_equal(scores, score(F, which, pair))
