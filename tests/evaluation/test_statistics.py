"""Figures of merit equal the metrics' and their definition, over seeds; intervals: published answers and coverage."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmtorch.evaluation.statistics import (
    MIN_SCENES,
    MIN_UNITS,
    RESAMPLES,
    bootstrap_mean,
    difference,
    effective_pairs,
    share_difference,
    share_interval,
)
from tests.reference.metrics import bootstrap_interval


def correlated(scenes: int, pairs: int, seed: int = 0) -> tuple[np.ndarray, list[str]]:
    """Hits of pairs whose chance of success is the scene's."""
    rng = np.random.default_rng(seed)
    chance = rng.beta(1, 1, scenes)
    names = [f"s{i}" for i in range(scenes) for _ in range(pairs)]
    return (rng.random(scenes * pairs) < chance.repeat(pairs)).astype(np.float64), names


def quantile_error(values: np.ndarray, clusters: int, resamples: int) -> float:
    """4.5 standard deviations of the difference of two estimates of a 2.5 % quantile of a normal variable."""
    density = 0.0585  # of the standard normal at its 2.5 % quantile
    means = values.reshape(clusters, -1).mean(1).std() / np.sqrt(clusters)
    return float(4.5 * np.sqrt(2) * means * np.sqrt(0.025 * 0.975 / resamples) / density)


@pytest.mark.parametrize("scenes", [MIN_SCENES - 1, 40])
def test_equals_the_reference(scenes: int) -> None:
    values, names = correlated(scenes, 12)
    result = bootstrap_mean(values, names)
    over_scenes = scenes >= MIN_SCENES
    clusters = names if over_scenes else [str(i) for i in range(len(names))]
    low, high = bootstrap_interval(values.tolist(), clusters, RESAMPLES)
    # Monte-Carlo error of both, and one step of the mean of 0/1 values, on which quantiles of few values lie.
    tolerance = quantile_error(values, len(set(clusters)), RESAMPLES) + 1 / len(values)
    assert result.over == ("scene" if over_scenes else "pair")
    assert result.value == values.mean()
    assert result.low == pytest.approx(low, abs=tolerance)
    assert result.high == pytest.approx(high, abs=tolerance)


def test_coverage_over_scenes() -> None:
    """Of independent data sets, about 95 % of the intervals hold the true mean, though pairs of a scene are alike."""
    trials, hold = 200, {"scene": 0, "pair": 0}
    for seed in range(trials):
        values, names = correlated(40, 10, seed)
        for over, clusters in (("scene", names), ("pair", ["one"] * len(names))):
            result = bootstrap_mean(values, clusters)
            assert result.over == over
            hold[over] += result.low <= 0.5 <= result.high
    # The percentile interval of 40 clusters is known to cover some 94 %; 3.5 standard deviations of a binomial share.
    assert hold["scene"] / trials > 0.94 - 3.5 * np.sqrt(0.94 * 0.06 / trials)
    assert hold["pair"] / trials < 0.75  # what ignoring the scenes would claim


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_no_spread_no_width(value: float) -> None:
    result = bootstrap_mean(np.full(7, value), list("abcdefg"))
    assert (result.value, result.low, result.high) == (value, value, value)
    assert bootstrap_mean(np.array([value]), ["a"]).low == value


def test_a_difference_of_the_same_pairs_is_sharper_than_apart() -> None:
    base, names = correlated(30, 10)
    rng = np.random.default_rng(1)
    better = np.maximum(base, rng.random(len(base)) < 0.1).astype(np.float64)  # a tenth of the misses become hits
    result, flipped, same = (difference(a, b, names) for a, b in ((better, base), (base, better), (base, base)))
    assert result.value == pytest.approx(better.mean() - base.mean(), abs=1e-12)
    assert result.low > 0
    assert result.high - result.low < bootstrap_mean(base, names).high - bootstrap_mean(base, names).low
    assert (flipped.low, flipped.high) == pytest.approx((-result.high, -result.low), abs=1e-12)
    assert (same.value, same.low, same.high) == (0, 0, 0)
    with pytest.raises(ValueError, match="a has 2 and b has 3"):
        difference(np.zeros(2), np.zeros(3), ["a", "b"])


def one_scene(n: int) -> list[str]:
    return ["s"] * n


def successes(r: int, n: int) -> np.ndarray:
    return np.arange(n) < r


@pytest.mark.parametrize(
    ("r", "n", "low", "high"),
    # Newcombe, "Two-sided confidence intervals for the single proportion", Statistics in Medicine 1998, method 3.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_published_answers(r: int, n: int, low: float, high: float) -> None:
    interval = share_interval(successes(r, n), one_scene(n))
    assert (interval.value, interval.over) == (r / n, "pair")
    assert (interval.low, interval.high) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize("n", [3, 10, 40])
def test_coverage_over_all_shares_is_the_level(n: int) -> None:
    """The mean coverage over p uniform in (0, 1), by the binomial sum: near 95 % for each n, unlike the bootstrap's."""
    p = (np.arange(2000) + 0.5) / 2000
    covered = np.zeros_like(p)
    for r in range(n + 1):
        interval = share_interval(successes(r, n), one_scene(n))
        chance = math.comb(n, r) * p**r * (1 - p) ** (n - r)
        covered += chance * ((interval.low <= p) & (p <= interval.high))
    assert 0.94 < covered.mean() < 0.97


def test_pairs_that_succeed_together_count_as_one() -> None:
    scenes = [f"s{i // 10}" for i in range(200)]
    together = np.repeat(np.arange(20) % 2 == 0, 10)
    # Every scene is all or nothing: as good as 20 pairs, whose variance has 19 degrees of freedom in place of 199.
    alike = 20 * (19 / 20) * (200 / 199) * (1.971957 / 2.093024) ** 2
    assert effective_pairs(together.astype(float), scenes) == pytest.approx(alike)
    apart = np.tile(np.arange(10) % 2 == 0, 20)
    assert 150 < effective_pairs(apart.astype(float), scenes) <= 200
    wide, narrow = share_interval(together, scenes), share_interval(apart, scenes)
    assert wide.high - wide.low > 2.5 * (narrow.high - narrow.low)
    assert wide.over == narrow.over == "scene"


def test_differences() -> None:
    a, b = successes(30, 40), successes(20, 40)
    scenes = one_scene(40)
    interval = share_difference(a, b, scenes)
    assert interval.value == 0.25
    # Bonett and Price by hand: n12 = 10, n21 = 0, n = 40.
    p, q = 11 / 42, 1 / 42
    half = 1.959964 * math.sqrt((p + q - (p - q) ** 2) / 42)
    assert (interval.low, interval.high) == pytest.approx((p - q - half, p - q + half))
    back = share_difference(b, a, scenes)
    assert (back.low, back.high) == pytest.approx((-interval.high, -interval.low))
    same = share_difference(a, a, scenes)
    assert same.value == 0
    assert same.low == -same.high < 0  # agreeing on forty pairs is no proof of being equal
    assert share_difference(a[:3], a[:3], scenes[:3]).high > 0.4


def test_means_of_few_pairs_have_no_interval() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random(MIN_UNITS), rng.random(MIN_UNITS)
    assert difference(a[1:], b[1:], one_scene(MIN_UNITS - 1)) is None
    interval = difference(a, b, one_scene(MIN_UNITS))
    assert interval.low < interval.value < interval.high
    six = [f"s{i % 6}" for i in range(9 * MIN_UNITS)]
    assert difference(np.tile(a, 9), np.tile(b, 9), six) is None


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(0, 9)), min_size=1, max_size=60))
def test_any_pairs_have_an_interval_around_their_share(rows: list[tuple[bool, bool, int]]) -> None:
    a, b = (np.array([row[i] for row in rows]) for i in (0, 1))
    scenes = [f"s{row[2]}" for row in rows]
    share, gain = share_interval(a, scenes), share_difference(a, b, scenes)
    assert 0 <= share.low <= share.value <= share.high <= 1
    assert share.high > share.low
    assert -1 <= gain.low <= gain.value <= gain.high <= 1
    assert 0 < effective_pairs(a.astype(float), scenes) <= len(rows)
