"""A score, a sampler and a rule of one's own: as good as built-in ones, nearly as fast, and refused where wrong."""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.core.types import Correspondences, collate
from fmtorch.geometry import sampson
from tests.estimators.own_parts import (
    BestHalf,
    CompiledTriweight,
    Sampled,
    Scored,
    Triweight,
    Welsch,
    Within2Px,
)
from tests.estimators.pairs import pair_of
from tests.laws import assert_same, few, scene

PARTS: dict[str, dict[str, Any]] = {
    "score": {"score": Welsch(1.0)},
    "compiled score": {"score": CompiledTriweight(1.0)},
    "sampler": {"sampler": BestHalf()},
    "rule": {"inliers": Within2Px()},
}
PRESETS = ("msac", "fmtorch")


def built(preset: str, parts: dict[str, Any], **options: Any) -> Any:
    """Few hypotheses. A score of one's own has a threshold of its own."""
    options |= {"threshold": None} if preset == "fmtorch" and "score" in parts else {}
    return presets.build("estimator", preset, **few(presets.load("estimator", preset)), **options, **parts)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", PARTS)
def test_estimates_are_as_good_as_with_built_in_parts(name: str, preset: str) -> None:
    pairs = [scene(i, 200, outliers=0.3) for i in range(8)]
    estimator, builtin = built(preset, PARTS[name]), built(preset, {})
    own, usual = estimator(collate(pairs)), builtin(collate(pairs))
    assert bool(own.ok.all())
    # 30 % outliers: 140 right matches of noise 0.3 px, nearly all of which a right model has for inliers.
    assert int(own.inliers.sum(1).min()) > 120
    assert abs(float(own.inliers.sum()) / float(usual.inliers.sum()) - 1) < (0.25 if name == "rule" else 0.05)
    for i in (0, 5):  # alone as in a batch
        alone = estimator(pairs[i])
        shared = {"F": own.F[i : i + 1], "inliers": own.inliers[i : i + 1]}
        assert_same({"F": alone.F, "inliers": alone.inliers}, shared, name)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_compiled_gain_is_that_in_numpy(preset: str) -> None:
    c = scene(1, 200)
    one, other = (built(preset, {"score": score(1.0)})(c) for score in (Triweight, CompiledTriweight))
    # Gains are rounded to 2^-10, which hides all but the rarest rounding of a float32.
    assert torch.equal(one.inliers, other.inliers)
    torch.testing.assert_close(one.F, other.F, rtol=0, atol=1e-9)


def test_a_rule_decides_the_inliers() -> None:
    c = scene(1, 200)
    found = built("msac", {"inliers": Within2Px()}, final="none", refit_inliers=True)(c)
    distance = sampson(found.F, c.x0.double(), c.x1.double())
    clear = (distance - 2).abs() > 1e-6
    assert torch.equal(found.inliers[clear], (distance <= 2)[clear])


@pytest.mark.parametrize(
    ("sample", "complaint"),
    [
        (lambda count, size: np.zeros((count, size), np.int64), r"returns int64 \(100, 7\); .* int64 \(7, 100\)"),
        (lambda count, size: np.zeros((size, count)), r"returns float64 \(7, 100\); it must be an array of int64"),
        (lambda count, size: np.full((size, count), 150), "indices from 150 to 150; they must be from 0 to 149"),
        (lambda count, size: np.full((size, count), -1), "indices from -1 to -1"),
        (None, "returns NoneType; it must be an array of int64"),
    ],
)
def test_wrong_samples_are_refused_by_name(sample: Any, complaint: str) -> None:
    with pytest.raises(ValueError, match=f"Sampled.draw returns .*{complaint.removeprefix('returns ')}"):
        built("msac", {"sampler": Sampled(sample)})(scene(1, 150))


@pytest.mark.parametrize(
    ("scores", "complaint"),
    [
        (lambda which: np.zeros(len(which) + 1), r"Scored returns float64 \(\d+,\); it must be an array of float64"),
        (lambda which: np.zeros(len(which), np.float32), "Scored returns float32"),
        (lambda which: 1.0, "Scored returns float; it must be"),
    ],
)
def test_wrong_scores_are_refused_by_name(scores: Any, complaint: str) -> None:
    for count in (60, 600):  # without and with preselection
        with pytest.raises(ValueError, match=complaint):
            built("msac", {"score": Scored(scores)})(scene(1, count))


def test_wrong_gains_are_refused_by_name() -> None:
    class Short(Welsch):
        def gain(self, squared: Any) -> Any:
            return squared[:, :3]

    with pytest.raises(ValueError, match=r"Short.gain returns shape \(\d+, 3\); it must be that of its argument"):
        built("msac", {"score": Short(1.0)})(scene(1, 60))
    with pytest.raises(NotImplementedError, match="Bare must override `gain` or name a `gain_kernel`"):
        built("msac", {"score": type("Bare", (type(Welsch(1.0)).__bases__[0],), {})(1.0)})(scene(1, 60))


@pytest.mark.parametrize(
    ("rule", "complaint"),
    [
        (lambda r2, pair: r2, r"returns float64 \(150,\); it must be an array of bool \(150,\)"),
        (lambda r2, pair: (r2 <= 1)[:9], r"returns bool \(9,\)"),
        (lambda r2, pair: [True] * len(r2), "returns list"),
    ],
)
def test_wrong_inliers_are_refused_by_name(rule: Any, complaint: str) -> None:
    with pytest.raises(ValueError, match=f"function {complaint}"):
        built("msac", {"inliers": rule})(scene(1, 150))


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_a_part_in_numpy_takes_at_most_three_times_as_long(preset: str) -> None:
    """A score, a sampler and a rule in NumPy together against the built-in ones, 2,000 matches."""
    c = scene(1, 2000, outliers=0.5)
    threshold = {} if preset == "msac" else {"threshold": None}
    own = presets.build("estimator", preset, score=Welsch(1.0), sampler=BestHalf(), inliers=Within2Px(), **threshold)
    ratio = milliseconds(own, c) / milliseconds(presets.build("estimator", preset), c)
    print(f"{preset}: {ratio:.2f} times as long")
    assert ratio < 3


def milliseconds(estimator: Any, c: Correspondences) -> float:
    estimator(c)
    times = []
    for _ in range(9):
        start = time.perf_counter()
        estimator(c)
        times.append(time.perf_counter() - start)
    return 1000 * statistics.median(times)


def test_samples_of_ones_own_are_distinct_and_from_the_better_half() -> None:
    pair = pair_of(scene(1, 41))
    sample = BestHalf().draw(pair, 3, 500, 7)
    assert pair.quality is not None
    better = np.argsort(pair.quality, kind="stable")[:20]
    assert all(len(set(column)) == 7 for column in sample.T)
    assert set(sample.ravel()) == set(better)
