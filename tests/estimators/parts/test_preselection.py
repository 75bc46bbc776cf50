"""Which models are scored on all matches, and on which few matches they are compared before."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fmtorch.estimators.options import Preselect
from fmtorch.estimators.pair import Pair
from fmtorch.estimators.preselection import Preselection, best, draw_by_prior, drawn_by_prior, shuffle, shuffled_first
from fmtorch.estimators.scores import InlierCount, Magsac, Msac, SaturatedGains
from fmtorch.jit.random import Stream
from tests.estimators.pairs import FEW, models, named
from tests.reference import sampling as reference
from tests.reference.random import number

SEED = 3


def numbers(pair: Pair) -> list[int]:
    return [number(pair.seed, pair.key, Stream.PRESELECTION, 0, i, 1) for i in range(pair.count)]


@pytest.mark.parametrize("given", ["scene 40", "scene 129", "scene 700", "7 random", "20 collinear"])
def test_few_matches_are_those_of_the_definitions(given: str) -> None:
    pair = named(given, seed=SEED)
    assert pair.prior is not None
    n, words, prior = pair.count, numbers(pair), pair.prior.copy()
    for count in (1, 5, n - 1, n, 2 * n):
        any_few, likely = shuffled_first(pair, count), drawn_by_prior(pair, count)
        np.testing.assert_array_equal(any_few.table, pair.table[:, reference.shuffled(range(n), words, count)])
        drawn = reference.priority_sample(prior.tolist(), words, count)
        np.testing.assert_array_equal(likely.points, pair.points[:, drawn])
        np.testing.assert_array_equal(likely.match_weight, prior[drawn] > 0)
    np.testing.assert_array_equal(pair.prior, prior)


def test_likely_matches_are_drawn_by_their_prior() -> None:
    """Three times as many of the kind three times as likely, and none that have no prior."""
    n, k, seen, keys = 900, 60, np.zeros(3), 300
    prior = np.repeat([0.0, 0.2, 0.6], n // 3)
    index = np.empty(k, np.int64)
    for key in range(keys):
        draw_by_prior(prior, 5, key, index)
        assert len(set(index.tolist())) == k
        seen += np.bincount(index // (n // 3), minlength=3)
    assert seen[0] == 0
    # 60 of 600 at a time: by their prior up to some 2 % (those drawn are missing later); 5 standard errors of a share.
    assert seen[2] / seen.sum() == pytest.approx(0.75, abs=0.02 + 5 * np.sqrt(0.75 * 0.25 / (k * keys)))
    draw_by_prior(np.zeros(n), 5, 0, index)
    np.testing.assert_array_equal(index, np.arange(k))


@pytest.mark.parametrize(("m", "k"), [(1, 1), (5, 5), (300, 96), (300, 1), (1000, 256)])
def test_the_best_of_a_round_and_the_first_of_equals(m: int, k: int) -> None:
    score = np.random.default_rng(m + k).integers(0, 40, m) / 8.0
    score[::7] = -np.inf
    which = np.empty(k, np.int64)
    best(score, which)
    np.testing.assert_array_equal(which, np.sort(np.argsort(-score, kind="stable")[:k]))


@pytest.mark.parametrize("score", [InlierCount(1.5), Msac(1.5, True), Magsac(1.5), SaturatedGains(1.5)])
@pytest.mark.parametrize("given", ["scene 700", "real 7"])
def test_the_models_that_pass_are_the_best_on_few_matches(given: str, score: Any) -> None:
    pair, options = named(given, seed=SEED), Preselect(matches=64, survivors=20)
    F = models(pair, 120).astype(np.float32)
    which, scores = Preselection(score, options)(F, pair)
    draw = drawn_by_prior if score.prior_weighted and pair.prior is not None else shuffled_first
    first = getattr(score, "preselection", score)(F, np.arange(120), draw(pair, 64))
    np.testing.assert_array_equal(which, np.sort(np.argsort(-first, kind="stable")[:20]))
    np.testing.assert_array_equal(scores, score(F, np.arange(120), pair)[which])


@pytest.mark.parametrize("given", ["scene 700", *FEW])
def test_all_models_are_scored_where_there_is_little_to_gain(given: str) -> None:
    """Without preselection, for no more models than pass, and for matches that are few anyway."""
    pair, score = named(given), Msac(1.5)
    F = models(pair, 30).astype(np.float32)
    few = None if pair.bucket >= 2 * 64 else Preselect(64, 20)
    for options in (None, Preselect(64, 30), Preselect(512, 20), few):
        which, scores = Preselection(score, options)(F, pair)
        np.testing.assert_array_equal(which, np.arange(30))
        np.testing.assert_array_equal(scores, score(F, np.arange(30), pair))


def test_a_pair_is_asked_once_for_its_few_matches() -> None:
    pair, preselection = named("scene 700"), Preselection(Msac(1.5), Preselect(64, 20))
    assert preselection.subset(pair) is preselection.subset(pair)


def test_shuffling_nothing() -> None:
    assert shuffle(5, 0, 0, np.empty(0, np.int64)) == 0
