from __future__ import annotations

import numpy as np
import pytest

from fmtorch.evaluation.statistics import MIN_SCENES, RESAMPLES, bootstrap_mean, paired_bootstrap
from tests.reference.bootstrap import bootstrap_interval


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


def test_scenes_of_unequal_size_weigh_by_their_pairs() -> None:
    values = np.array([1.0] * 6 + [0.0, 0.5, 0.0, 1.0])
    result = bootstrap_mean(values, list("aaaaaabcde"))
    assert result.value == 0.75
    assert result.low < 0.75 < result.high


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


def test_repeatable_and_blind_to_names_and_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    values, names = correlated(10, 5)
    result = bootstrap_mean(values, names)
    assert bootstrap_mean(values, names) == result
    assert bootstrap_mean(values, ["x" + name for name in names]) == result
    monkeypatch.setattr("fmtorch.evaluation.statistics._BLOCK", 70)
    again = bootstrap_mean(values, names)
    assert again.low == pytest.approx(result.low, abs=quantile_error(values, 10, RESAMPLES))


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_no_spread_no_width(value: float) -> None:
    result = bootstrap_mean(np.full(7, value), list("abcdefg"))
    assert (result.value, result.low, result.high) == (value, value, value)
    assert bootstrap_mean(np.array([value]), ["a"]).low == value


def test_paired_is_sharper_than_apart() -> None:
    base, names = correlated(30, 10)
    rng = np.random.default_rng(1)
    better = np.maximum(base, rng.random(len(base)) < 0.1).astype(np.float64)  # a tenth of the misses become hits
    result = paired_bootstrap(better, base, names)
    assert result.value == pytest.approx(better.mean() - base.mean(), abs=1e-12)
    assert result.low > 0
    assert result.high - result.low < bootstrap_mean(base, names).high - bootstrap_mean(base, names).low
    flipped = paired_bootstrap(base, better, names)
    assert (flipped.low, flipped.high) == pytest.approx((-result.high, -result.low), abs=1e-12)
    same = paired_bootstrap(base, base, names)
    assert (same.value, same.low, same.high) == (0, 0, 0)


def test_paired_needs_the_same_pairs() -> None:
    with pytest.raises(ValueError, match="a has 2 and b has 3"):
        paired_bootstrap(np.zeros(2), np.zeros(3), ["a", "b"])
