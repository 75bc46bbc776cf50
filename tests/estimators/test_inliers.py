"""Residuals in pixels, rules of inliers and the stopping rule, against their definitions."""

import math

import numpy as np
import pytest

import fmtorch
from fmtorch.estimators import (
    BetterHalf,
    InlierRule,
    PriorWeighted,
    Prosac,
    RobustDeviations,
    Sampler,
    StoppingRule,
    Uniform,
    WithinThreshold,
)
from fmtorch.estimators.inliers import residuals_squared_px
from tests.estimators.pairs import FEW, SCALES, models, named
from tests.estimators.residuals import residuals
from tests.reference import known_cameras
from tests.reference import ransac as reference


@pytest.mark.parametrize("given", ["scene 150", "real 7", *FEW])
def test_residuals_are_squared_sampson_distances_in_pixels(given: str) -> None:
    for scale in SCALES if given in FEW else (1.0,):
        pair = named(given, scale)
        for F in models(pair, 8)[1:]:
            squared = residuals_squared_px(F, pair)
            r = residuals(F, pair, 1.0, np.float64)  # per noise
            noise = np.ones(pair.count) if pair.noise is None else pair.noise
            low, high = r.low * noise, r.high * noise
            assert ((low**2 * (1 - 1e-15) <= squared) & (squared <= high**2 * (1 + 1e-15))).all()


@pytest.mark.parametrize("count", [7, 8, 9, 20, 151])
def test_rules_are_those_of_the_definitions(count: int) -> None:
    pair, rng = named(f"scene {count}"), np.random.default_rng(count)
    for r in (
        rng.uniform(0, 3, count),
        rng.integers(0, 3, count) * 1.0,
        np.zeros(count),
        10.0 ** rng.uniform(-9, 9, count),
    ):
        median = reference.lower_median((r**2).tolist())
        sigma = 1.4826 * (1 + 5 / max(count - 7, 1)) * math.sqrt(median)
        rules: list[tuple[InlierRule, list[bool]]] = [
            (WithinThreshold(1.5), [x <= 1.5**2 for x in r**2]),
            (BetterHalf(), [x <= max(median, 1e-6) for x in r**2]),
            (RobustDeviations(), [x <= max(2.5 * sigma, 1e-3) ** 2 for x in r**2]),
        ]
        for rule, expected in rules:
            assert rule(r**2, pair).tolist() == expected


@pytest.mark.parametrize("name", ["lmeds", "cf_ransac", "paper/lmeds"])
def test_all_exact_matches_are_inliers(name: str) -> None:
    """Whose deviations are rounding, of which a half is larger than the median."""
    s = known_cameras.scene(5, 150)
    inliers = fmtorch.find_fundamental(s.x0, s.x1, estimator=name).inliers[0].numpy()
    assert inliers[s.right].all()
    assert not inliers[~s.right].any()


def test_limits_belong_to_the_inliers_and_are_none_beyond_the_range_of_numbers() -> None:
    pair = named("scene 8")
    squared = np.array([0, 4, np.nextafter(4, 5), 1e300, np.inf, np.nan, 1, 2])
    assert WithinThreshold(2.0)(squared, pair).tolist() == [True, True, False, False, False, False, True, True]
    assert WithinThreshold(1e200)(squared, pair).sum() == 7
    assert not WithinThreshold(1e-200)(squared, pair)[1:].any()


@pytest.mark.parametrize("probability", [0.5, 0.99, 0.9999])
@pytest.mark.parametrize("sampler", [Uniform(), Prosac(), PriorWeighted()])
def test_a_search_stops_after_as_many_draws_as_it_takes(sampler: Sampler, probability: float) -> None:
    pair = named("scene 150")
    shares = set()
    for F in models(pair, 12)[1:].astype(np.float32):
        for threshold in (0.1, 1.0, 10.0, 100.0):
            inside = residuals_squared_px(F.astype(np.float64), pair) <= threshold**2
            weight = sampler.weight(pair)  # type: ignore[attr-defined]
            share = float(weight[inside].sum() / weight.sum())
            for size in (5, 7):
                stop = StoppingRule(probability, threshold, sampler)
                if share in (0, 1):
                    assert stop(F, 10**9, pair, size) == (share == 1)
                    continue
                draws = reference.draws_for_confidence(share, size, probability)
                assert stop(F, math.ceil(draws * (1 + 1e-9)), pair, size)
                assert not stop(F, math.ceil(draws * (1 - 1e-9)) - 1, pair, size)
                shares.add(share)
    assert len(shares) > 10
