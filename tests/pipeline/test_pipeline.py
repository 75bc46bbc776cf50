"""The four stages in a row: outcomes, failures as data, shared features, independence of batches."""

import threading
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.core import Correspondences, Estimate, Features
from fmtorch.data import ImagePair, ImageSource
from fmtorch.pipeline import Memo
from tests.helpers import draw, pair
from tests.helpers import small_pipeline as pipeline


@pytest.fixture
def pairs(tmp_path: Path) -> list[ImagePair]:
    a, b = draw(tmp_path / "a.png", 0), draw(tmp_path / "b.png", 0, shift=12)
    c, d = draw(tmp_path / "c.png", 1), draw(tmp_path / "d.png", 1, shift=7)
    flat = tmp_path / "flat.png"
    cv2.imwrite(str(flat), np.full((240, 320), 128, np.uint8))
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"\xff\xd8\xff\xe0 not a picture")
    return [
        pair("good", a, b),
        pair("flat", a, ImageSource("flat", flat)),
        pair("good too", c, d),
        pair("broken", ImageSource("broken", broken), b),
        pair("absent", a, ImageSource("absent", tmp_path / "absent.png")),
        pair("known", a, b, problem="pairs.txt, line 3: F is NaN"),
    ]


def test_failures_are_outcomes_with_reasons(pairs: list[ImagePair]) -> None:
    outcomes = pipeline().run(pairs)
    by_name = {o.pair.identity: o for o in outcomes}
    assert [o.pair.identity for o in outcomes] == [p.identity for p in pairs]
    for name in ("good", "good too"):
        estimate = by_name[name].estimate
        assert bool(estimate.ok[0])
        assert by_name[name].reason == ""
        assert set(by_name[name].seconds) == {"features", "matching", "pruning", "estimation"}
    assert by_name["flat"].reason == "no keypoints in image 1"
    assert "broken.jpg" in by_name["broken"].reason
    assert "absent.png" in by_name["absent"].reason
    assert by_name["known"].reason == "pairs.txt, line 3: F is NaN"


def test_an_estimator_that_says_nothing_of_significance_is_judged(pairs: list[ImagePair]) -> None:
    own = presets.build("estimator", "lmeds", hypotheses=200)

    def silent(c: Correspondences, seed: int = 0) -> Estimate:
        return own(c, seed).replace(significance=None)

    outcomes = [pipeline(estimator=estimator).run(pairs[:3]) for estimator in (own, silent)]
    for first, second in zip(*outcomes, strict=True):
        if first.estimate is not None and second.estimate is not None:
            assert torch.equal(first.estimate.significance, second.estimate.significance)
    assert [o.estimate is not None and bool(o.estimate.related[0]) for o in outcomes[1]] == [True, False, True]


def test_batches_change_nothing(pairs: list[ImagePair]) -> None:
    together = pipeline().run(pairs, seed=3)
    for each, outcome in zip(pairs, together, strict=True):
        (alone,) = pipeline().run([each], seed=3)
        assert alone.reason == outcome.reason
        if alone.estimate is not None and outcome.estimate is not None:
            assert torch.equal(alone.estimate.F, outcome.estimate.F)
            assert int(alone.estimate.inliers.sum()) == int(outcome.estimate.inliers.sum())


def test_match_stops_before_estimation(pairs: list[ImagePair]) -> None:
    outcome = pipeline().correspondences(pairs[:1])[0]
    assert outcome.estimate is None
    assert int(outcome.correspondences.count()) > 50
    assert int(outcome.correspondences.keys[0]) == pairs[0].key


class _Counting:
    """An extractor that counts its calls, and fails on request."""

    def __init__(self) -> None:
        self.calls = 0
        self.inner = presets.build("features", "sift", max_features=500)

    def __call__(self, image: np.ndarray) -> Features:
        self.calls += 1
        result: Features = self.inner(image)
        return result


def test_features_of_an_image_are_computed_once(pairs: list[ImagePair]) -> None:
    counting = _Counting()
    shared = pipeline(features=counting)
    shared.run([pairs[0], pairs[0], pairs[5]])
    assert counting.calls == 2


class _Raising:
    """A stage that cannot bear one pair."""

    def __init__(self, key: int, inner: Callable[[Correspondences], Correspondences | Estimate]) -> None:
        self.key, self.inner = key, inner

    def __call__(self, c: Correspondences, seed: int = 0) -> Correspondences | Estimate:
        if self.key in c.keys.tolist():
            raise RuntimeError("no, not this one")
        return self.inner(c)


@pytest.mark.parametrize("stage", ["pruning", "estimation"])
def test_a_stage_that_raises_fails_only_the_culprit(pairs: list[ImagePair], stage: str) -> None:
    inner = (
        presets.build("pruner", "ratio") if stage == "pruning" else presets.build("estimator", "lmeds", hypotheses=200)
    )
    raising = _Raising(pairs[0].key, inner)
    parts = {"pruners": {"bad": raising}} if stage == "pruning" else {"estimator": raising}
    outcomes = pipeline(**parts).run([pairs[0], pairs[2]])
    assert outcomes[0].reason.startswith(f"{stage}: RuntimeError: no, not this one (test_pipeline.py:")
    assert outcomes[0].estimate is None
    assert outcomes[1].reason == ""
    assert outcomes[1].estimate is not None


def test_memo_computes_once_among_threads_and_forgets_the_oldest() -> None:
    memo: Memo[int, int] = Memo(2)
    calls: list[int] = []
    started, release = threading.Event(), threading.Event()

    def slow() -> int:
        calls.append(0)
        started.set()
        release.wait(5)
        return 7

    results: list[int] = []
    threads = [threading.Thread(target=lambda: results.append(memo.get(0, slow))) for _ in range(3)]
    threads[0].start()
    started.wait(5)
    for thread in threads[1:]:
        thread.start()
    release.set()
    for thread in threads:
        thread.join()
    assert results == [7, 7, 7]
    assert len(calls) == 1
    assert memo.get(1, lambda: 1) == 1
    assert memo.get(2, lambda: 2) == 2
    assert memo.get(0, lambda: 8) == 8  # 0 was forgotten
