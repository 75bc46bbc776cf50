"""The search: models belong to their draws, the best are kept, the earlier of equals, and rounds end when told."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fmtorch.estimators import (
    EightPoint,
    Msac,
    Pair,
    Preselect,
    PriorWeighted,
    Prosac,
    Sampler,
    SevenPoint,
    StoppingRule,
    Uniform,
)
from fmtorch.estimators.models.model import Hypotheses
from fmtorch.estimators.preselection import Preselection
from fmtorch.estimators.search import Pool, Search, Verified, merge
from tests.estimators.pairs import named, pair_of
from tests.laws import scene
from tests.reference import solvers as reference


@dataclasses.dataclass
class Told(StoppingRule):
    """A stopping rule that does as told, and counts how often it is asked."""

    answer: Callable[[int], bool]
    asked: list[int] = dataclasses.field(default_factory=list)

    def __call__(self, F: Any, draws: int, pair: Pair, size: int) -> bool:
        self.asked.append(draws)
        return self.answer(draws)


class Late(SevenPoint):
    """Samples before the hundredth give no model."""

    def solve(self, pair: Pair, sample: Any, start: int) -> Hypotheses:
        hypotheses = super().solve(pair, sample, start)
        return hypotheses if start >= 100 else hypotheses._replace(F=hypotheses.F[:0], draw=hypotheses.draw[:0])


def search(family: Any = None, sampler: Sampler | None = None, **options: Any) -> Search:
    preselection = Preselection(Msac(1.0), options.pop("preselect", None))
    options = {"pool": 4, "hypotheses": 150, "round": 50, **options}
    return Search(family or SevenPoint(), sampler or Uniform(), preselection, **options)


@pytest.mark.parametrize("family", [SevenPoint(), EightPoint()])
@pytest.mark.parametrize("sampler", [Uniform(), Prosac(), PriorWeighted()])
def test_models_are_those_of_the_samples_of_their_draws(family: Any, sampler: Sampler) -> None:
    """In the order of draws; each sample gives those that the definition gives and that its matches' sides agree to."""
    pair, draws, alike = named("scene 300"), 60, 0
    sample = sampler.draw(pair, 40, draws, family.size)
    hypotheses = family.solve(pair, sample, 40)
    assert hypotheses.start == 40
    np.testing.assert_array_equal(hypotheses.sample, sample)
    assert (np.diff(hypotheses.draw) >= 0).all()
    for d in range(draws):
        x0, x1 = pair.points[:2, sample[:, d]].T, pair.points[2:, sample[:, d]].T
        every = reference.seven_point(x0, x1) if family.size == 7 else [reference.eight_point(x0, x1)]
        expected = [F for F in every if reference.consistently_oriented(F, x0, x1)]
        models = [reference.unit(F.astype(np.float64).reshape(3, 3)) for F in hypotheses.F[hypotheses.draw == d]]
        # Models are float32, of norm one; what is left of rounding grows where a sample is nearly degenerate.
        alike += len(models) == len(expected) and all(
            min(min(np.abs(F - other).max(), np.abs(F + other).max()) for other in expected) < 1e-5 for F in models
        )
    assert alike >= 0.95 * draws
    assert len(hypotheses.F) > 10


def test_a_pool_keeps_the_best_and_the_earlier_of_equals() -> None:
    pool = Pool.empty(3)
    assert pool.models.shape == (1, 9)
    assert not pool.models.any()
    assert pool.valid.tolist() == [False]

    def offer(scores: list[float], first: int) -> None:
        F = np.repeat(np.arange(first, first + len(scores), dtype=np.float32)[:, None], 9, 1)
        pool.merge(Verified(F, np.arange(len(scores)), np.array(scores)))

    offer([1.0, 3.0], 10)
    assert (pool.filled, pool.valid.tolist()) == (2, [True, True])
    offer([3.0, np.nan, -np.inf, 2.0, 0.0, np.inf], 20)
    assert pool.score.tolist() == [3.0, 3.0, 2.0]
    assert pool.F[:, 0].tolist() == [11, 20, 23]
    offer([3.0, 2.0], 30)
    assert pool.F[:, 0].tolist() == [11, 20, 30]


@pytest.mark.parametrize(("m", "k", "size"), [(1, 1, 1), (300, 96, 12), (40, 40, 100)])
def test_a_pool_is_a_stable_sort_of_all_that_it_was_offered(m: int, k: int, size: int) -> None:
    rng = np.random.default_rng(m)
    F, score = rng.normal(size=(m, 9)).astype(np.float32), rng.integers(-20, 20, m) / 8.0
    which = np.sort(rng.permutation(m)[:k])
    pool, pool_score, filled = np.zeros((size, 9), np.float32), np.full(size, -np.inf), 0
    for part in np.array_split(which, 3):
        filled = merge(F, part, score[part], filled, pool, pool_score)
    best = which[np.argsort(-score[which], kind="stable")][:size]
    assert filled == len(best)
    np.testing.assert_array_equal(pool[:filled], F[best])
    np.testing.assert_array_equal(pool_score[:filled], score[best])


@pytest.mark.parametrize("preselect", [None, Preselect(64, 20)])
def test_a_search_keeps_the_best_models_of_all_rounds(preselect: Preselect | None) -> None:
    pair, single = named("scene 300"), search(preselect=preselect, round=50)
    pool = single(pair, 30)
    F, score = [], []
    for start in (30, 80, 130):
        hypotheses = single.family.solve(pair, Uniform().draw(pair, start, 50, 7), start)
        which, scores = single.preselection(hypotheses.F, pair)
        F.append(hypotheses.F[which])
        score.append(scores)
    best = np.argsort(-np.concatenate(score), kind="stable")[:4]
    np.testing.assert_array_equal(pool.F, np.concatenate(F)[best])
    np.testing.assert_array_equal(pool.score, np.concatenate(score)[best])
    assert (pool.filled, pool.samples) == (4, 180)


def test_rounds_change_nothing_without_preselection() -> None:
    """Random numbers belong to draws."""
    pair = named("scene 300")
    once, often = (search(round=round)(pair) for round in (150, 40))
    np.testing.assert_array_equal(once.F, often.F)
    np.testing.assert_array_equal(once.score, often.score)


def test_a_search_ends_when_the_stopping_rule_says_so() -> None:
    pair = named("scene 300")
    never, second = Told(lambda draws: False), Told(lambda draws: draws >= 100)
    assert search(stop=never)(pair).samples == 150
    assert never.asked == [50, 100]  # after the last round there is nothing to decide
    assert search(stop=second)(pair).samples == 100
    assert search(round=500, stop=Told(lambda draws: True))(pair).samples == 150


def test_a_search_goes_on_while_no_sample_gave_a_model() -> None:
    """All matches are inliers of the zero model that an empty pool holds."""
    pair = pair_of(scene(0, 100, outliers=0.0, noise=0.0))
    pool = search(Late(), stop=StoppingRule(0.9999, 1.0, Uniform()), hypotheses=400)(pair)
    assert pool.filled
    assert pool.samples == 150
