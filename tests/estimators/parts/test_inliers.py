"""Inlier rules and the stopping rule, from their definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fmtorch.estimators.parts.inliers import (
    BetterHalf,
    RobustDeviations,
    StoppingRule,
    WithinThreshold,
    lower_median,
    residuals_squared_px,
    share_within,
)
from fmtorch.estimators.parts.sampling import PriorWeighted, Uniform
from tests.estimators.pairs import pair_of
from tests.laws import scene
from tests.reference import ransac as reference


def test_residuals_are_sampson_distances() -> None:
    pair = pair_of(scene(1, 100))
    F = np.random.default_rng(0).normal(size=9)
    r2 = residuals_squared_px(F, pair)
    for i in range(100):
        r = reference.sampson(F.reshape(3, 3), pair.points[:2, i], pair.points[2:, i]) * pair.pixels_per_unit
        assert math.sqrt(r2[i]) == pytest.approx(r, rel=1e-9)


@pytest.mark.parametrize("count", [8, 9, 300])
def test_rules(count: int) -> None:
    pair, r2 = pair_of(scene(1, count)), np.random.default_rng(count).gamma(1.0, 2.0, count)
    np.testing.assert_array_equal(WithinThreshold(1.5)(r2, pair), np.sqrt(r2) <= 1.5)
    median = sorted(r2)[(count + 1) // 2 - 1]
    assert lower_median(r2) == median
    np.testing.assert_array_equal(BetterHalf()(r2, pair), r2 <= median)
    sigma = 1.4826 * (1 + 5 / (count - 7)) * math.sqrt(median)
    np.testing.assert_array_equal(RobustDeviations()(r2, pair), np.sqrt(r2) <= 2.5 * sigma)


def test_infinite_residuals_are_no_inliers() -> None:
    pair = pair_of(scene(1, 9))
    r2 = np.array([0.1] * 6 + [np.inf] * 3)
    for rule in (WithinThreshold(1.0), BetterHalf(), RobustDeviations()):
        np.testing.assert_array_equal(rule(r2, pair), [True] * 6 + [False] * 3)


@pytest.mark.parametrize("size", [4, 7, 8])
@pytest.mark.parametrize("sampler", [Uniform(), PriorWeighted()])
def test_stops_after_the_draws_that_confidence_asks_for(sampler: Uniform | PriorWeighted, size: int) -> None:
    pair = pair_of(scene(3, 200, outliers=0.5))
    F = np.random.default_rng(0).normal(size=9)
    r2, weight = residuals_squared_px(F.astype(np.float32).astype(np.float64), pair), sampler.weight(pair)
    threshold = math.sqrt(np.quantile(r2, 0.6))
    share = share_within(r2, threshold * threshold, weight)
    assert share == weight[r2 <= threshold * threshold].sum() / weight.sum()
    rule = StoppingRule(0.99, threshold, sampler)
    needed = reference.draws_for_confidence(share, size, 0.99)
    assert not rule(F.astype(np.float32), math.floor(needed), pair, size)
    assert rule(F.astype(np.float32), math.floor(needed) + 1, pair, size)
