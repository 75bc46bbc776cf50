"""Figures of merit equal the metrics' and their definition, over seeds; intervals: published answers and coverage."""

import math

import numpy as np
import pytest

from fmtorch.evaluation.statistics import (
    bootstrap_mean,
    share_interval,
)


def correlated(scenes: int, pairs: int, seed: int = 0) -> tuple[np.ndarray, list[str]]:
    """Hits of pairs whose chance of success is the scene's."""
    rng = np.random.default_rng(seed)
    chance = rng.beta(1, 1, scenes)
    names = [f"s{i}" for i in range(scenes) for _ in range(pairs)]
    return (rng.random(scenes * pairs) < chance.repeat(pairs)).astype(np.float64), names


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


def one_scene(n: int) -> list[str]:
    return ["s"] * n


def successes(r: int, n: int) -> np.ndarray:
    return np.arange(n) < r


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
