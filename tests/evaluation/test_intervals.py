"""Intervals of shares: published answers, coverage, and what few or equal pairs allow."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmtorch.evaluation.statistics import (
    MIN_SCENES,
    MIN_UNITS,
    effective_pairs,
    mean_difference,
    share_difference,
    share_interval,
)


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


def test_three_right_pairs_do_not_prove_perfection() -> None:
    interval = share_interval(successes(3, 3), one_scene(3))
    assert interval.high == 1.0
    assert interval.low == pytest.approx(3 / (3 + 1.959964**2))  # p = 1: n / (n + z^2)
    nothing = share_interval(successes(0, 3), one_scene(3))
    assert (nothing.low, nothing.high) == pytest.approx((0.0, 1 - interval.low))


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


def test_coverage_of_pairs_in_scenes() -> None:
    """Right in 95 % of draws of 12 scenes of 8 pairs each, whose shares are Beta(4, 1): to three standard errors."""
    rng = np.random.default_rng(0)
    names = [f"s{i // 8}" for i in range(96)]
    trials = 1500
    hit = 0
    for _ in range(trials):
        chance = np.repeat(rng.beta(4, 1, 12), 8)
        interval = share_interval(rng.random(96) < chance, names)
        hit += interval.low <= 0.8 <= interval.high
    assert hit / trials > 0.95 - 3 * math.sqrt(0.95 * 0.05 / trials) - 0.01  # Wilson's own dips below the level


def test_few_scenes_are_not_the_units() -> None:
    values = np.tile([1.0, 0.0], 20)
    assert effective_pairs(values, [f"s{i % (MIN_SCENES - 1)}" for i in range(40)]) == 40
    assert effective_pairs(np.ones(1), ["s"]) == 1


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
    assert mean_difference(a[1:], b[1:], one_scene(MIN_UNITS - 1)) is None
    interval = mean_difference(a, b, one_scene(MIN_UNITS))
    assert interval is not None
    assert interval.low < interval.value < interval.high
    assert (
        mean_difference(np.tile(a, 9), np.tile(b, 9), [f"s{i % 6}" for i in range(9 * MIN_UNITS)]) is None
    )  # 6 scenes


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(0, 9)), min_size=1, max_size=60))
def test_any_pairs_have_an_interval_around_their_share(rows: list[tuple[bool, bool, int]]) -> None:
    a, b = (np.array([row[i] for row in rows]) for i in (0, 1))
    scenes = [f"s{row[2]}" for row in rows]
    share, difference = share_interval(a, scenes), share_difference(a, b, scenes)
    assert 0 <= share.low <= share.value <= share.high <= 1
    assert share.high > share.low
    assert -1 <= difference.low <= difference.value <= difference.high <= 1
    assert 0 < effective_pairs(a.astype(float), scenes) <= len(rows)
