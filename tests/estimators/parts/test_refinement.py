"""The models of a pool refined: on which matches, and no worse than they were."""

from __future__ import annotations

import numpy as np
import pytest

from fmtorch.core.streams import Stream
from fmtorch.estimators.families.fundamental import SevenPoint
from fmtorch.estimators.options import Refine
from fmtorch.estimators.pair import Pair
from fmtorch.estimators.parts.inliers import residuals_squared_px
from fmtorch.estimators.parts.preselection import Preselection
from fmtorch.estimators.parts.refinement import Refinement
from fmtorch.estimators.parts.sampling import Uniform
from fmtorch.estimators.parts.scores import Msac
from fmtorch.estimators.search import Pool, Search
from tests.estimators.pairs import pair_of
from tests.laws import scene
from tests.reference import sampling as reference
from tests.reference.random import number


def searched(pair: Pair, pool: int = 4) -> Pool:
    return Search(SevenPoint(), Uniform(), Preselection(Msac(1.0), None), pool, 200, 200)(pair)


@pytest.mark.parametrize("matches", [10, 50, 1000])
def test_matches_near_a_model_of_the_pool_in_a_random_order(matches: int) -> None:
    pair = pair_of(scene(1, 300), 5)
    pool, options = searched(pair), Refine("truncated", scale=1.0, matches=matches)
    near = Refinement(options).near(pool, pair)
    r2 = np.min([residuals_squared_px(F, pair) for F in pool.models], 0)
    inside = r2 <= (Refine.RADIUS * options.scale) ** 2
    # Those whose float32 residual may be on either side of the radius are left out of the comparison.
    unsure = np.abs(np.sqrt(r2) / (Refine.RADIUS * options.scale) - 1) < 1e-3
    assert not unsure.any()
    numbers = [number(5, pair.key, Stream.REFINEMENT, 0, i, 1) for i in range(pair.count)]
    expected = reference.shuffled(np.flatnonzero(inside).tolist(), numbers, matches)
    np.testing.assert_array_equal(near.points, pair.points[:, expected])


def test_all_matches_where_no_number_is_named() -> None:
    pair = pair_of(scene(1, 100))
    assert Refinement(Refine("truncated")).near(searched(pair), pair) is pair
    assert Refinement(None).near(searched(pair), pair) is pair


def test_nothing_is_near_an_empty_pool() -> None:
    pair = pair_of(scene(1, 100))
    refined = Refinement(Refine("truncated", matches=50))(Pool.empty(3), pair, SevenPoint())
    assert refined.near.count == 0
    assert refined.valid.tolist() == [False]


@pytest.mark.parametrize("loss", ["truncated", "cauchy", "geman_mcclure", "magsac"])
def test_models_refined_by_a_redescending_loss_fit_better(loss: str) -> None:
    pair = pair_of(scene(1, 200, outliers=0.2))
    pool = searched(pair)
    refined = Refinement(Refine(loss, scale=2.0, iterations=8))(pool, pair, SevenPoint())
    for before, after in zip(pool.models, refined.F, strict=True):
        medians = [np.median(residuals_squared_px(F, pair)) for F in (before, after)]
        assert medians[1] <= medians[0] * 1.05  # the loss falls; the median is another figure, which may rise a little
        assert abs(np.linalg.norm(after) - 1) < 1e-12
        assert np.linalg.svd(after.reshape(3, 3))[1][2] < 1e-12
