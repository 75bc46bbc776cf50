"""Parts of one's own: as good as the built-in ones, refused by name where they return something else."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from fmtorch import presets
from fmtorch.core.types import Correspondences, collate
from fmtorch.estimators import F4x2, Pair, SummedGains, kernel
from fmtorch.estimators.parts.sampling import Uniform
from tests.estimators.pairs import pair_of
from tests.laws import scene, scenes
from tests.processes import run_command


class Squares(SummedGains):
    """MSAC in NumPy; what is negative counts nothing."""

    def gain(self, squared: Any) -> Any:
        return 1 - squared


@kernel
def truncated(squared: F4x2, out: F4x2) -> None:
    """MSAC, compiled."""
    for k in range(len(squared)):
        for i in range(squared.shape[1]):
            out[k, i] = max(1 - squared[k, i], 0)


class CompiledSquares(SummedGains):
    gain_kernel = truncated


class Welsch(SummedGains):
    """exp(-r^2) (Dennis & Welsch 1978)."""

    def gain(self, squared: Any) -> Any:
        return np.exp(-squared)


class Equal:
    """The built-in uniform sampler, under another name."""

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Any:
        return Uniform().draw(pair, start, count, size)


class BestHalf:
    """Samples of the better half of the matches."""

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Any:
        quality = np.zeros(pair.count) if pair.quality is None else pair.quality
        best = np.argsort(quality, kind="stable")[: max(size, pair.count // 2)]
        drawn = (pair.uniform(start, count, size) * (len(best) - np.arange(size))).astype(np.int64)
        for j in range(1, size):  # counted among those not drawn yet
            for earlier in np.sort(drawn[:, :j], axis=1).T:
                drawn[:, j] += drawn[:, j] >= earlier
        return best[drawn].T


def within_1_px(squared_px: Any, pair: Pair) -> Any:
    return squared_px <= 1.0


def assert_same(parts: dict[str, Any], c: Correspondences) -> None:
    """The estimates of MSAC are the same, to the bit."""
    built_in, own = presets.build("estimator", "msac")(c, 3), presets.build("estimator", "msac", **parts)(c, 3)
    assert bool(built_in.ok.any())
    for field in ("F", "inliers", "ok", "draws"):
        assert torch.equal(getattr(own, field), getattr(built_in, field)), field
    assert own.reason == built_in.reason


@pytest.mark.parametrize(
    "parts",
    [
        {"score": Squares(1.0)},
        {"score": CompiledSquares(1.0)},
        {"sampler": Equal()},
        {"inliers": within_1_px},
        {"score": CompiledSquares(1.0), "sampler": Equal(), "inliers": within_1_px},
    ],
)
def test_parts_that_do_as_the_built_in_ones_give_the_same_estimates(parts: dict[str, Any]) -> None:
    assert_same(parts, scenes())


def test_parts_keep_the_laws() -> None:
    """What stands beside a pair is not seen, nor the order of rounds."""
    pairs = [scene(i, 150) for i in range(3)]
    parts = {"score": Welsch(1.0), "sampler": BestHalf(), "inliers": within_1_px}
    together = presets.build("estimator", "msac", **parts)(collate(pairs))
    assert bool(together.ok.all())
    for i, pair in enumerate(pairs):
        alone = presets.build("estimator", "msac", **parts)(pair)
        assert torch.equal(alone.F[0], together.F[i])
        assert torch.equal(alone.inliers[0], together.inliers[i])


def test_named_as_a_target_in_a_preset() -> None:
    score = {"_target_": f"{__name__}.Welsch", "threshold": 1.0}
    sampler = {"_target_": f"{__name__}.BestHalf"}
    estimator = presets.build("estimator", "msac", score=score, sampler=sampler)
    assert bool(estimator(scene(0)).ok)


class Draws:
    """A sampler that draws what it is told."""

    def __init__(self, samples: Any) -> None:
        self.samples = samples

    def draw(self, pair: Pair, start: int, count: int, size: int) -> Any:
        return self.samples(count, size)


def of_sevens(value: Any, dtype: type = np.int64) -> Draws:
    return Draws(lambda count, size: np.full((size, count), value, dtype))


@pytest.mark.parametrize(
    ("sampler", "message"),
    [
        (Draws(lambda count, size: np.zeros((count, size), np.int64)), r"\(500, 7\) of int64; .* \(7, 500\) of int64"),
        (Draws(lambda count, size: np.zeros((size, 1), np.int64)), r"\(7, 1\) of int64; .* \(7, 500\) of int64"),
        (of_sevens(0, np.int32), r"\(7, 500\) of int32; it must be an array \(7, 500\) of int64"),
        (of_sevens(0.0, np.float64), r"\(7, 500\) of float64; it must be an array \(7, 500\) of int64"),
        (Draws(lambda count, size: [[0] * count] * size), r"list; it must be an array \(7, 500\) of int64"),
        (of_sevens(150), "indices from 150 to 150; matches are 0 to 149"),
        (of_sevens(-1), "indices from -1 to -1; matches are 0 to 149"),
    ],
)
def test_samples_that_are_none_are_refused(sampler: Draws, message: str) -> None:
    with pytest.raises(ValueError, match=f"Draws.draw returns {message}"):
        presets.build("estimator", "msac", sampler=sampler)(scene(0))


@pytest.mark.parametrize(
    ("gains", "returned"),
    [
        (lambda squared: squared[:, :-1], r"\(\d+, 63\) of float32"),
        (lambda squared: squared.sum(1), r"\(\d+,\) of float32"),
        (lambda squared: 1.0, r"\(\) of float64"),
        (lambda squared: squared + 0j, r"\(\d+, 64\) of complex64"),
        (lambda squared: [["one"] * 64] * len(squared), r"\(\d+, 64\) of <U3"),
    ],
)
def test_gains_that_are_none_are_refused(gains: Any, returned: str) -> None:
    class Mine(SummedGains):
        def gain(self, squared: Any) -> Any:
            return gains(squared)

    message = rf"Mine.gain returns shape {returned}; it must be the shape of its argument, \(\d+, 64\): .* of numbers"
    with pytest.raises(ValueError, match=message):
        presets.build("estimator", "msac", score=Mine(1.0), preselect={"matches": 64, "survivors": 5})(scene(0))


@pytest.mark.parametrize(
    ("scores", "returned"),
    [
        (lambda k: np.zeros(k + 1), r"\(\d+,\) of float64"),
        (lambda k: np.zeros((k, 1)), r"\(\d+, 1\) of float64"),
        (lambda k: np.zeros(k, np.float32), r"\(\d+,\) of float32"),
        (lambda k: [0.0] * k, "list"),
        (lambda k: None, "NoneType"),
    ],
)
@pytest.mark.parametrize("preselect", [None, {"matches": 64, "survivors": 5}])
def test_scores_that_are_none_are_refused(scores: Any, returned: str, preselect: Any) -> None:
    class Mine:
        prior_weighted = False

        def __call__(self, F: Any, which: Any, pair: Pair) -> Any:
            return scores(len(which))

    with pytest.raises(ValueError, match=rf"Mine returns {returned}; it must be an array \(\d+,\) of float64"):
        presets.build("estimator", "msac", score=Mine(), threshold=None, preselect=preselect)(scene(0))


@pytest.mark.parametrize("found", [np.ones(3, np.bool_), np.ones(150), None, [True] * 150])
def test_inliers_that_are_none_are_refused(found: Any) -> None:
    class Rule:
        def __call__(self, squared_px: Any, pair: Pair) -> Any:
            return found

    with pytest.raises(ValueError, match=r"Rule returns (.|\n)*; it must be an array \(150,\) of bool"):
        presets.build("estimator", "msac", inliers=Rule())(scene(0))


def ratio(name: str) -> float:
    """The CPU time of a preset with parts in NumPy in that of the preset: each the least of some estimates."""
    c, scale = scene(0, 600), presets.load("estimator", name)["threshold"]
    parts = {"score": Welsch(scale), "threshold": None, "sampler": BestHalf(), "inliers": within_1_px}
    estimators = presets.build("estimator", name, **parts), presets.build("estimator", name)
    least = [float("inf")] * 2
    for _ in range(20):
        for k, estimator in enumerate(estimators):
            start = time.process_time()
            estimator(c)
            least[k] = min(least[k], time.process_time() - start)
    return least[0] / least[1]


def test_samples_of_the_better_half_are_distinct_and_uniform() -> None:
    pair = pair_of(scene(0, 40))
    assert pair.quality is not None
    sample = BestHalf().draw(pair, 100, 2000, 7)
    ordered = np.sort(sample, 0)
    assert (ordered[1:] > ordered[:-1]).all()
    counts = np.bincount(sample[6], minlength=40)[np.argsort(pair.quality, kind="stable")]
    assert not counts[20:].any()
    assert stats.chisquare(counts[:20]).pvalue > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["msac", "fmtorch"])
def test_parts_in_numpy_take_at_most_three_times_the_time(name: str, tmp_path: Path) -> None:
    """In a process whose calls are not checked, as a user's are not."""
    code = f"from {__name__} import ratio; print('ratio', ratio({name!r}))"
    ended = run_command("-c", code, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert 0 < float(ended.stdout.split()[-1]) <= 3, ended.stdout
