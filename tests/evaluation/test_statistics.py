"""Figures of merit equal the metrics' and their definition, over seeds; intervals leave out what is not defined."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from fmtorch import metrics
from fmtorch.evaluation.statistics import (
    MERITS,
    PERCENT,
    areas,
    bootstrap_mean,
    described,
    difference,
    interval,
    mean_difference,
    recalled,
    scene_names,
    share_difference,
    share_interval,
)
from tests.reference import metrics as reference


def errors(*shape: int) -> np.ndarray:
    nsgd = np.random.default_rng(0).uniform(0, 0.1, shape)
    nsgd.flat[:4] = (0.0, 0.05, 1.0, math.nan)
    return nsgd


def test_means_over_pairs_are_the_metrics() -> None:
    nsgd = errors(50)
    tensor = torch.from_numpy(nsgd)
    assert recalled(nsgd).mean() == pytest.approx(float(metrics.recall(tensor)))
    assert recalled(nsgd, 0.01).mean() == pytest.approx(float(metrics.recall(tensor, 0.01)))
    assert areas(nsgd).mean() == pytest.approx(float(metrics.mean_recall(tensor)))
    assert areas(nsgd).mean() == pytest.approx(reference.mean_recall(np.nan_to_num(nsgd, nan=1.0), 0.05))
    assert set(recalled(nsgd)) == {0.0, 1.0}
    assert (recalled(nsgd)[:4].tolist(), areas(nsgd)[:4].tolist()) == ([1, 0, 0, 0], [1, 0, 0, 0])


def test_seeds_are_averaged_pair_by_pair() -> None:
    nsgd = errors(3, 20)
    for values in MERITS.values():
        np.testing.assert_allclose(values(nsgd), np.mean([values(seed_nsgd) for seed_nsgd in nsgd], axis=0), rtol=1e-15)


def test_intervals_are_of_what_is_defined() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 30))
    scenes = [f"s{i % 12}" for i in range(30)]
    incomplete = a.copy()
    incomplete[::4] = math.nan
    kept = [i for i in range(30) if i % 4]
    expected = bootstrap_mean(a[kept], [scenes[i] for i in kept])
    assert interval(incomplete, scenes) == expected
    percent = interval(incomplete, scenes, PERCENT)
    assert percent is not None
    assert (percent.value, percent.low, percent.high) == tuple(
        PERCENT * end for end in (expected.value, expected.low, expected.high)
    )
    assert difference(incomplete, b, scenes) == mean_difference(a[kept], b[kept], [scenes[i] for i in kept])
    assert difference(b, incomplete, scenes) == mean_difference(b[kept], a[kept], [scenes[i] for i in kept])
    nothing = np.full(30, math.nan)
    assert interval(nothing, scenes) is None
    assert difference(nothing, b, scenes) is None
    assert f"{expected:.1f}" == f"{expected.value:.1f} [{expected.low:.1f}, {expected.high:.1f}]"


def test_shares_have_the_intervals_of_shares_over_several_seeds_too() -> None:
    """As every run's summary; the mean over equal seeds is one seed."""
    nsgd = np.random.default_rng(2).uniform(0, 0.1, (2, 40))
    scenes = [f"s{i % 8}" for i in range(40)]
    a, b = (recalled(e) for e in nsgd)
    assert interval(a, scenes, share=True) == share_interval(nsgd[0] < 0.05, scenes)
    assert difference(a, b, scenes, share=True) == share_difference(nsgd[0] < 0.05, nsgd[1] < 0.05, scenes)
    twice = recalled(np.stack([nsgd[0], nsgd[0]]))
    assert interval(twice, scenes, share=True) == interval(a, scenes, share=True)
    both = recalled(nsgd)
    gain = difference(both, b, scenes, share=True)
    assert gain is not None
    assert gain.value == pytest.approx((a.mean() - b.mean()) / 2)
    assert gain.low < gain.value < gain.high


def test_what_intervals_resample_is_said() -> None:
    assert described(["a"]) == "1 pair of 1 scene, intervals over pairs"
    assert described(list("aabbcdcd")) == "8 pairs of 4 scenes, intervals over pairs"
    assert described(list("abcdeabcde")) == "10 pairs of 5 scenes, intervals over scenes"


def test_one_name_in_two_families_is_two_scenes() -> None:
    assert len(set(scene_names(["indoor", "orbit", "orbit"], ["s0", "s0", "s0"]))) == 2
