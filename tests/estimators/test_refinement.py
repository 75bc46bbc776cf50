"""Which matches a pool is refined on, and its models afterwards."""

import numpy as np
import pytest

from fmtorch.estimators import Msac, Pair, Ransac, Refine, SevenPoint
from fmtorch.estimators.refinement import Candidates, Refinement
from fmtorch.estimators.search import Pool
from fmtorch.estimators.selection import BestOfSearch, BestScore, scores_of
from fmtorch.jit.random import Stream
from tests.estimators.pairs import FEW, SCALES, models, named, pair_of
from tests.estimators.residuals import residuals
from tests.laws import scene
from tests.reference import refine as reference
from tests.reference.random import number
from tests.reference.ransac import shuffled


def pool_of(F: np.ndarray) -> Pool:
    return Pool(F.astype(np.float32), np.arange(len(F), 0, -1.0), len(F))


@pytest.mark.parametrize("name", ["scene 40", "scene 300", "real 7", *FEW])
def test_matches_near_a_pool(name: str) -> None:
    """Within four scales of a model, the first in the order of their random numbers; nothing is near a zero model."""
    for scale in SCALES if name in FEW else (1.0,):
        pair, F = named(name, scale, seed=2), models(named(name, scale), 6)
        reach = Refine.RADIUS * 1.5 * scale
        rs = [residuals(model, pair, reach * pair.pixels_per_noise / pair.pixels_per_unit) for model in F[1:]]
        surely = set(np.flatnonzero(np.any([r.high < 1 for r in rs], 0)).tolist())
        perhaps = set(np.flatnonzero(np.any([r.low <= 1 for r in rs], 0)).tolist())
        words = [number(pair.seed, pair.key, Stream.REFINEMENT, 0, i, 1) for i in range(pair.count)]
        options = Refine("truncated", 1.5 * scale, matches=pair.count)
        near = Refinement(options).near(pool_of(F), pair)
        index = [int(np.flatnonzero((pair.table == column[:, None]).all(0))[0]) for column in near.table.T]
        if len({tuple(column) for column in pair.table.T}) == pair.count:  # else equal matches are not told apart
            assert surely <= set(index) <= perhaps
            assert index == shuffled(sorted(index), words, pair.count)
        for count in (1, 5):
            fewer = Refinement(Refine("truncated", 1.5 * scale, matches=count)).near(pool_of(F), pair)
            np.testing.assert_array_equal(fewer.table, near.table[:, :count])


def test_all_matches_are_near_without_a_number_of_them() -> None:
    pair, F = named("scene 40"), models(named("scene 40"), 3)
    assert Refinement(Refine("truncated")).near(pool_of(F), pair) is pair
    assert Refinement(None).near(pool_of(F), pair) is pair
    nothing = Refinement(Refine("truncated", matches=10)).near(Pool.empty(4), pair)
    assert nothing.count == 0


@pytest.mark.parametrize("loss", ["truncated", "geman_mcclure", "cauchy", "huber", "magsac"])
@pytest.mark.parametrize("name", ["scene 40", "scene 300", "real 7"])
def test_refined_models_have_lower_errors(name: str, loss: str) -> None:
    pair, scale = named(name), 2.0
    pool = Ransac(hypotheses=200, pool=4).search(pair)
    refined = Refinement(Refine(loss, scale, iterations=20))(pool, pair, SevenPoint())
    assert refined.valid.all()
    assert refined.near is pair

    def cost(F: np.ndarray, pair: Pair) -> float:
        r = residuals(F, pair, scale, np.float64).exact
        return float((pair.weight * reference.loss(r**2, 1.0, loss) / pair.pixels_per_noise**2).sum())

    before, after = ([cost(F, pair) for F in models] for models in (pool.models, refined.F))
    assert all(a <= b * (1 + 1e-6) for a, b in zip(after, before, strict=True))  # first made rank 2, to float32
    assert any(a < b * (1 - 1e-3) for a, b in zip(after, before, strict=True))


def test_local_optimisation_comes_first() -> None:
    pair, F = named("scene 40"), models(named("scene 40"), 3)[1:]
    refined = Refinement(None, lambda F, pair: F + 1)(pool_of(F), pair, SevenPoint())
    np.testing.assert_array_equal(refined.F, F.astype(np.float32).astype(np.float64) + 1)
    plain = Refinement(None)(Pool.empty(3), pair, SevenPoint())
    assert plain.valid.tolist() == [False]


def test_the_first_of_the_pool_or_the_best_score_of_what_is_valid() -> None:
    pair = pair_of(scene(1, 100))
    F = np.random.default_rng(0).normal(size=(6, 9))
    scores = scores_of(Msac(50.0), F, pair)
    best = int(np.argmax(scores))
    assert best > 0
    everything = Candidates(F, np.ones(6, np.bool_), pair)
    np.testing.assert_array_equal(BestOfSearch()(everything, pair).F, F[0])
    np.testing.assert_array_equal(BestScore(Msac(50.0))(everything, pair).F, F[best])
    valid = np.arange(6) != best
    second = int(np.argmax(np.where(valid, scores, -np.inf)))
    np.testing.assert_array_equal(BestScore(Msac(50.0))(Candidates(F, valid, pair), pair).F, F[second])
    assert not BestScore(Msac(50.0))(Candidates(F, np.zeros(6, np.bool_), pair), pair).valid
