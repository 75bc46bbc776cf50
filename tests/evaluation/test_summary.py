"""Summaries: figures, intervals, reasons of failures."""

import dataclasses
import json
import math
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import scipy
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from fmtorch import metrics
from fmtorch.core import pair_key
from fmtorch.evaluation import common_reasons, statistics, summarize, summary_markdown, terminal_tables
from fmtorch.runs import PairRow, to_table

F = (0.0, -0.5, 0.1, 0.5, 0.0, -0.1, 0.2, 0.3, 0.59)


def good(name: str, nsgd: float, **changes: Any) -> PairRow:
    row = PairRow(
        pair=name, key=pair_key(name), family="indoor", scene="s0", ok=True, nsgd=nsgd, nsgd_released=nsgd,
        inlier_rate=0.75, inlier_rate_before=0.5, corrs=100, corrs_before=400, F=F, seconds_features=1.0,
        seconds_matching=0.5, seconds_pruning=0.0, seconds_estimation=0.25, seconds_metrics=0.125,
    )  # fmt: skip
    return dataclasses.replace(row, **changes)


def bad(name: str, reason: str = "5 matches; at least 8 are needed", **changes: Any) -> PairRow:
    row = PairRow(pair=name, key=pair_key(name), family="indoor", scene="s0", ok=False, reason=reason)
    return dataclasses.replace(row, **changes)


def known() -> pa.Table:
    rows = [
        good("a", 0.0, scene="s0"),
        good("b", 0.005, scene="s1", inlier_rate=None, corrs=0),
        good("c", 0.025, scene="s2", seconds_features=3.0),
        good("d", 0.05, scene="s3"),
        bad("e", scene="s4", inlier_rate_before=0.9, corrs_before=7, seconds_features=2.0),
        bad("f", "7 matches; at least 8 are needed", scene="s5", family="orbit"),
        bad("g", "no keypoints in a|b.png", scene="s5", family="orbit"),
        good("h", 0.049, scene="s5", family="orbit", inlier_rate=1.0, nsgd_released=None),
    ]
    return to_table(rows)


def test_known_answer() -> None:
    summary = summarize(known())
    assert list(summary) == ["indoor", "orbit", "all"]
    indoor, orbit, everything = summary.values()
    assert (indoor["pairs"], indoor["scenes"], indoor["failures"], indoor["failure_share"]) == (5, 5, 1, 0.2)
    assert indoor["recall"] == pytest.approx(3 / 5)  # strictly below 0.05
    assert indoor["recall_fine"] == pytest.approx(2 / 5)
    assert indoor["auc_05"] == pytest.approx((1 + 0.9 + 0.5 + 0 + 0) / 5)
    assert indoor["recall_released"] == pytest.approx(3 / 5)
    assert indoor["interval_over"] == "scene"
    assert indoor["inlier_rate"] == pytest.approx(0.75)  # of the pairs that did not fail and have a rate
    assert indoor["inlier_rate_failures_0"] == pytest.approx(3 * 0.75 / 5)
    assert indoor["inlier_rate_before"] == pytest.approx(0.5)
    assert indoor["inlier_rate_before_failures_0"] == pytest.approx(4 * 0.5 / 5)
    assert (indoor["corrs"], indoor["corrs_before"]) == (pytest.approx(75), pytest.approx(400))
    assert (indoor["seconds"]["features"], indoor["seconds"]["total"]) == (1.0, 1.875)
    assert orbit["interval_over"] == "pair"
    assert orbit["recall_released"] is None
    assert orbit["recall"] == pytest.approx(1 / 3)
    assert (everything["recall"], everything["scenes"]) == (pytest.approx(4 / 8), 6)
    assert everything["reasons"] == {"5 to 7 matches; at least 8 are needed": 2, "no keypoints in a|b.png": 1}
    low, high = everything["recall_interval"]
    assert 0 <= low < everything["recall"] < high <= 1


def test_seconds_that_nobody_measured_are_not_zero() -> None:
    unmeasured = {f"seconds_{stage}": None for stage in ("features", "matching", "pruning", "estimation", "metrics")}
    assert summarize(to_table([good("a", 0.0, **unmeasured)]))["all"]["seconds"]["total"] is None


@pytest.mark.parametrize("rows", [[], [bad("a")], [good("a", 0.2)], [bad("a"), bad("b", family="x")]], ids=len)
def test_nothing_breaks_on_few_or_failed_pairs(rows: list[PairRow]) -> None:
    summary = summarize(to_table(rows))
    assert summary["all"]["pairs"] == len(rows)
    json.dumps(summary, allow_nan=False)
    assert summary_markdown(summary, title="t").startswith("# t\n")
    _render(summary, 80)


def _render(summary: dict[str, dict[str, Any]], width: int) -> str:
    console = Console(width=width, record=True, file=None, color_system=None)
    with console.capture() as capture:
        console.print(terminal_tables(summary, "sift_ratio on rendered")[0])
    return capture.get()


def test_terminal_table_fits_80_columns() -> None:
    text = _render(summarize(known()), 80)
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in text
    indoor = next(line.split() for line in lines if line.strip().startswith("indoor"))
    assert indoor[1:3] == ["5", "60.0"]
    assert {"75.0", "(50.0)", "75", "(400)"} <= set(indoor)
    assert "scenes (indoor, all); pairs (orbit)" in " ".join(text.split())


def test_markdown() -> None:
    text = summary_markdown(summarize(known()), title="sift_ratio on rendered")
    lines = text.splitlines()
    tables = [line.replace("\\|", "").count("|") for line in lines if line.startswith("|")]
    assert (set(tables[:5]), set(tables[5:])) == ({13}, {8})
    assert "| indoor | 5 | 5 | 60.0 [" in text
    assert "a\\|b.png" in text
    assert "1 (20.0%)" in text


def posed(name: str, rotation: float, translation: float, **changes: Any) -> PairRow:
    return good(name, 0.01, rotation_error=rotation, translation_error=translation, **changes)


def test_poses_known_answer() -> None:
    """By the larger angle, of the pairs with known cameras; a failed one is a miss."""
    failed = bad("d", rotation_error=180.0, translation_error=90.0, pose_reason="no F")
    unknown = good("e", 0.0, pose_reason="K0, K1 unknown", family="orbit")
    rows = [posed("a", 0.5, 2.0), posed("b", 4.5, 1.0), posed("c", 1.0, 12.0), failed, unknown]
    indoor, orbit, everything = summarize(to_table(rows)).values()
    assert orbit["pose"] is None
    assert everything["pose"] == indoor["pose"]
    pose = indoor["pose"]
    assert pose["pairs"] == 4
    errors = torch.tensor([2.0, 4.5, 12.0, 180.0], dtype=torch.float64)
    assert [pose[f"auc_{t}"] for t in (5, 10, 20)] == pytest.approx(metrics.pose_auc(errors).tolist())
    assert [pose[f"map_{t}"] for t in (5, 10, 20)] == pytest.approx([2 / 4, 2 / 4, (2 + 2 + 3 + 3) / 16])
    assert pose["maa_10"] == pytest.approx((0 + 1 + 1 + 1 + 6 * 2) / 40)
    assert (pose["rotation"], pose["translation"]) == (2.75, 7.0)


def correlated(scenes: int, pairs: int, seed: int = 0) -> tuple[np.ndarray, list[str]]:
    """Hits of pairs whose chance of success is the scene's."""
    rng = np.random.default_rng(seed)
    chance = rng.beta(1, 1, scenes)
    names = [f"s{i}" for i in range(scenes) for _ in range(pairs)]
    return (rng.random(scenes * pairs) < chance.repeat(pairs)).astype(np.float64), names


def quantile_error(means: np.ndarray, resamples: int) -> float:
    """4.5 standard deviations of the difference of two estimates of a 2.5 % quantile of a normal variable."""
    density = 0.0585  # of the standard normal at its 2.5 % quantile
    deviation = means.std() / np.sqrt(len(means))
    return float(4.5 * np.sqrt(2) * deviation * np.sqrt(0.025 * 0.975 / resamples) / density)


@pytest.mark.parametrize("scenes", [statistics.MIN_SCENES - 1, 40])
def test_equals_the_reference(scenes: int) -> None:
    values, names = correlated(scenes, 12)
    result = statistics.bootstrap_mean(values, names)
    over_scenes = scenes >= statistics.MIN_SCENES
    clusters = scenes if over_scenes else len(names)
    means = values.reshape(clusters, -1).mean(1)  # of clusters of one size, whose mean is that of all values
    options = {"n_resamples": statistics.RESAMPLES, "method": "percentile", "random_state": 0}
    low, high = scipy.stats.bootstrap((means,), np.mean, **options).confidence_interval
    # Monte-Carlo error of both, and one step of the mean of 0/1 values, on which quantiles of few values lie.
    tolerance = quantile_error(means, statistics.RESAMPLES) + 1 / len(values)
    assert (result.over, result.value) == ("scene" if over_scenes else "pair", values.mean())
    assert result.low == pytest.approx(low, abs=tolerance)
    assert result.high == pytest.approx(high, abs=tolerance)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_no_spread_no_width(value: float) -> None:
    for names in ("abcdefg", "a"):
        result = statistics.bootstrap_mean(np.full(len(names), value), list(names))
        assert (result.value, result.low, result.high) == (value, value, value)


def test_a_difference_of_the_same_pairs_is_sharper_than_apart() -> None:
    base, names = correlated(30, 10)
    rng = np.random.default_rng(1)
    better = np.maximum(base, rng.random(len(base)) < 0.1).astype(np.float64)  # a tenth of the misses become hits
    both = ((better, base), (base, better), (base, base))
    result, flipped, same = (statistics.difference(a, b, names) for a, b in both)
    assert result.value == pytest.approx(better.mean() - base.mean(), abs=1e-12)
    assert result.low > 0
    alone = statistics.bootstrap_mean(base, names)
    assert result.high - result.low < alone.high - alone.low
    assert (flipped.low, flipped.high) == pytest.approx((-result.high, -result.low), abs=1e-12)
    assert (same.value, same.low, same.high) == (0, 0, 0)
    with pytest.raises(ValueError, match="a has 2 and b has 3"):
        statistics.difference(np.zeros(2), np.zeros(3), ["a", "b"])


def successes(r: int, n: int) -> np.ndarray:
    return np.arange(n) < r


@pytest.mark.parametrize(
    ("r", "n", "low", "high"),
    # Newcombe, "Two-sided confidence intervals for the single proportion", Statistics in Medicine 1998, method 3.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_published_answers(r: int, n: int, low: float, high: float) -> None:
    interval = statistics.share_interval(successes(r, n), ["s"] * n)
    assert (interval.value, interval.over) == (r / n, "pair")
    assert (interval.low, interval.high) == pytest.approx((low, high), abs=5e-5)


def test_pairs_that_succeed_together_count_as_one() -> None:
    scenes = [f"s{i // 10}" for i in range(200)]
    together = np.repeat(np.arange(20) % 2 == 0, 10)
    # Every scene is all or nothing: as good as 20 pairs, whose variance has 19 degrees of freedom in place of 199.
    alike = 20 * (19 / 20) * (200 / 199) * (1.971957 / 2.093024) ** 2
    assert statistics.effective_pairs(together.astype(float), scenes) == pytest.approx(alike)
    apart = np.tile(np.arange(10) % 2 == 0, 20)
    assert 150 < statistics.effective_pairs(apart.astype(float), scenes) <= 200
    wide, narrow = statistics.share_interval(together, scenes), statistics.share_interval(apart, scenes)
    assert wide.high - wide.low > 2.5 * (narrow.high - narrow.low)
    assert wide.over == narrow.over == "scene"


def test_differences() -> None:
    a, b, scenes = successes(30, 40), successes(20, 40), ["s"] * 40
    interval = statistics.share_difference(a, b, scenes)
    assert interval.value == 0.25
    # Bonett and Price by hand: n12 = 10, n21 = 0, n = 40.
    p, q = 11 / 42, 1 / 42
    half = 1.959964 * math.sqrt((p + q - (p - q) ** 2) / 42)
    assert (interval.low, interval.high) == pytest.approx((p - q - half, p - q + half))
    back = statistics.share_difference(b, a, scenes)
    assert (back.low, back.high) == pytest.approx((-interval.high, -interval.low))
    same = statistics.share_difference(a, a, scenes)
    assert same.value == 0
    assert same.low == -same.high < 0  # agreeing on forty pairs is no proof of being equal
    assert statistics.share_difference(a[:3], a[:3], scenes[:3]).high > 0.4


def test_means_of_few_pairs_have_no_interval() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random(statistics.MIN_UNITS), rng.random(statistics.MIN_UNITS)
    assert statistics.difference(a[1:], b[1:], ["s"] * len(a[1:])) is None
    interval = statistics.difference(a, b, ["s"] * len(a))
    assert interval.low < interval.value < interval.high
    six = [f"s{i % 6}" for i in range(9 * statistics.MIN_UNITS)]
    assert statistics.difference(np.tile(a, 9), np.tile(b, 9), six) is None


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(0, 9)), min_size=1, max_size=60))
def test_any_pairs_have_an_interval_around_their_share(rows: list[tuple[bool, bool, int]]) -> None:
    a, b = (np.array([row[i] for row in rows]) for i in (0, 1))
    scenes = [f"s{row[2]}" for row in rows]
    share, gain = statistics.share_interval(a, scenes), statistics.share_difference(a, b, scenes)
    assert 0 <= share.low <= share.value <= share.high <= 1
    assert share.high > share.low
    assert -1 <= gain.low <= gain.value <= gain.high <= 1
    assert 0 < statistics.effective_pairs(a.astype(float), scenes) <= len(rows)


@pytest.mark.parametrize(
    ("reasons", "expected"),
    [
        (["7 matches"], {"7 matches": 1}),
        ([f"{n} matches" for n in (7, 5, 7, 10)], {"5 to 10 matches": 4}),  # in the order of numbers, not of letters
        (["no image scene/00000012.png", "no image scene/00000034.png"], {"no image scene/000000….png": 2}),
        (["none in image 0", "late", "none in image 1"], {"none in image 0 to 1": 2, "late": 1}),
        (["share 0.5, too small", "share 0.25, too small"], {"share 0.25 to 0.5, too small": 2}),
        (["F7", "8"], {"…": 2}),
        (["a"] * 2 + ["b"] * 4 + ["c"] + ["d"] * 3, {"b": 4, "d": 3, "a": 2}),  # the three commonest
        ([], {}),
    ],
)
def test_reasons_that_differ_in_numbers_are_one(reasons: list[str], expected: dict[str, int]) -> None:
    """And the commonest come first."""
    common = common_reasons(reasons, 3)
    assert (common, list(common)) == (expected, list(expected))
