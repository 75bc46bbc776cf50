"""One search for every family: models belong to their draws, the best are kept, and the earlier of equals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fmtorch.estimators.families.fundamental import EightPoint, SevenPoint
from fmtorch.estimators.families.homography import Homography
from fmtorch.estimators.pair import Pair
from fmtorch.estimators.parts.preselection import Preselection
from fmtorch.estimators.parts.sampling import PriorWeighted, Prosac, Uniform
from fmtorch.estimators.parts.scores import Msac
from fmtorch.estimators.search import Pool, Search, Verified
from tests.estimators.pairs import pair_of
from tests.laws import scene


@pytest.mark.parametrize("family", [SevenPoint(), EightPoint(), Homography()])
@pytest.mark.parametrize("sampler", [Uniform(), Prosac(), PriorWeighted()])
def test_models_belong_to_the_samples_of_their_draws(family: Any, sampler: Any) -> None:
    pair = pair_of(scene(1, 300))
    sample = sampler.draw(pair, 40, 30, family.size)
    hypotheses = family.solve(pair, sample, 40)
    assert (np.diff(hypotheses.draw) >= 0).all()
    assert set(hypotheses.draw) <= set(range(30))
    for k in range(30):
        alone = family.solve(pair, np.ascontiguousarray(sample[:, k : k + 1]), 40 + k)
        np.testing.assert_array_equal(hypotheses.F[hypotheses.draw == k], alone.F)


def offer(pool: Pool, scores: list[float], first: int) -> None:
    F = np.repeat(np.arange(first, first + len(scores), dtype=np.float32)[:, None], 9, 1)
    pool.merge(Verified(F, np.arange(len(scores)), np.array(scores)))


def test_a_pool_keeps_the_best_and_the_earlier_of_equals() -> None:
    pool = Pool.empty(3)
    assert pool.valid.tolist() == [False]
    offer(pool, [1.0, 3.0, -np.inf, np.nan], 10)
    assert pool.valid.tolist() == [True, True]
    offer(pool, [3.0, 2.0, 0.0], 20)
    assert pool.score.tolist() == [3.0, 3.0, 2.0]
    assert pool.F[:, 0].tolist() == [11.0, 20.0, 21.0]


class Stop:
    """A rule that stops after some rounds, and remembers what it was asked."""

    def __init__(self, after: int) -> None:
        self.after, self.asked = after, list[int]()

    def __call__(self, F: np.ndarray, draws: int, pair: Pair, size: int) -> bool:
        self.asked.append(draws)
        return len(self.asked) >= self.after


def search(hypotheses: int, stop: Any = None, pool: int = 4) -> Search:
    return Search(SevenPoint(), Uniform(), Preselection(Msac(1.0), None), pool, hypotheses, 50, stop)


def test_a_search_ends_where_its_rule_is_content() -> None:
    pair, stop = pair_of(scene(1, 300)), Stop(2)
    pool = search(220, stop)(pair)
    assert stop.asked == [50, 100]
    assert pool.draws == 100
    np.testing.assert_array_equal(pool.F, search(100)(pair).F)


def test_the_rule_is_not_asked_after_the_last_round() -> None:
    stop = Stop(99)
    assert search(120, stop)(pair_of(scene(1, 300))).draws == 120  # rounds of 50, 50, 20
    assert stop.asked == [50, 100]


def test_the_pool_holds_the_best_of_all_draws() -> None:
    pair = pair_of(scene(1, 300))
    pool = search(150, pool=5)(pair)
    F = SevenPoint().solve(pair, Uniform().draw(pair, 0, 150, 7), 0).F
    score = Msac(1.0)(F, np.arange(len(F)), pair)
    np.testing.assert_array_equal(pool.score, np.sort(score)[::-1][:5])
    assert search(150)(pair, start=150).draws == 300
