from __future__ import annotations

import itertools
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from fmtorch.core.executors import Execution, Team
from fmtorch.data.pairs import ImageSource
from fmtorch.pipeline import folder
from fmtorch.pipeline.build import load_pipeline
from fmtorch.pipeline.folder import FolderMatches
from fmtorch.pipeline.photograph_cameras import PhotographCameras
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.storage.exchange.journal import Journal


class Recorded(Executor):
    """An executor of one's own, which does what is submitted at once and records the names of the functions."""

    def __init__(self, error: Exception | None = None) -> None:
        self.calls: list[str] = []
        self.error = error

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.calls.append(fn.func.__name__)
        future: Future[Any] = Future()
        try:
            if self.error is not None:
                raise self.error
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def built() -> Pipeline:
    options = ["features.max_features=300", "estimator=lmeds", "estimator.hypotheses=30"]
    return load_pipeline("sift_ratio", overrides=options)


@pytest.fixture
def pipeline() -> Pipeline:
    return built()


@pytest.fixture
def images(tmp_path: Path) -> list[Path]:
    """Six crops of one texture."""
    noise = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
    texture = cv2.GaussianBlur(cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC), (0, 0), 1.5)
    (tmp_path / "photos").mkdir()
    paths = [tmp_path / "photos" / f"{i}.png" for i in range(6)]
    for i, path in enumerate(paths):
        assert cv2.imwrite(str(path), texture[8 * i : 8 * i + 240, 16 * i : 16 * i + 320])
    return paths


def work(pipeline: Pipeline, images: list[Path], output: Path, **options: Any) -> FolderMatches:
    return FolderMatches(pipeline, Journal(output, images[0].parent), 1600, True, 0, **options)


def kept(output: Path) -> dict[str, dict[str, Any]]:
    files = sorted(output.rglob("*.npz"))
    return {path.name: dict(np.load(path)) for path in files}


def test_any_number_of_workers_and_any_executor_keep_the_same(
    pipeline: Pipeline, images: list[Path], tmp_path: Path
) -> None:
    pairs = list(itertools.combinations(images, 2))
    executor = Recorded()
    for name, options in {"one": {"workers": 1}, "three": {"workers": 3}, "own": {"executor": executor}}.items():
        matches = work(pipeline, images, tmp_path / name, **options)
        assert len(list(matches.each(pairs))) == matches.done == len(pairs)
        assert matches.troubles == []
    assert Counter(executor.calls) == {"described_image": 6, "matched_pair": 15}
    expected = kept(tmp_path / "one")
    assert len(expected) == 21
    for name in ("three", "own"):
        stored = kept(tmp_path / name)
        assert stored.keys() == expected.keys()
        for file, arrays in expected.items():
            for key, value in arrays.items():
                np.testing.assert_array_equal(stored[file][key], value)


@pytest.mark.parametrize("send", [False, True])
def test_processes_keep_the_same(pipeline: Pipeline, images: list[Path], tmp_path: Path, send: bool) -> None:
    pairs = list(itertools.combinations(images[:4], 2))
    list(work(pipeline, images, tmp_path / "threads").each(pairs))
    team = Team(Execution("processes", 2), ("fmtorch.pipeline.folder",))
    try:
        options = {"executor": team.executor, "workers": 2, "build": built, "send_images": send}
        matches = work(pipeline, images, tmp_path / "processes", **options)
        list(matches.each(pairs))
    finally:
        team.close()
    assert (matches.done, matches.troubles) == (6, [])
    expected, stored = kept(tmp_path / "threads"), kept(tmp_path / "processes")
    assert stored.keys() == expected.keys()
    for file, arrays in expected.items():
        for key, value in arrays.items():
            np.testing.assert_array_equal(stored[file][key], value)


def test_no_image_is_described_twice(
    pipeline: Pipeline, images: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    described: list[str] = []
    lock, plain = threading.Lock(), folder.read_image

    def counted(image: ImageSource, **options: Any) -> Any:
        with lock:
            described.append(image.path.name)
        return plain(image, **options)

    monkeypatch.setattr(folder, "read_image", counted)
    matches = work(pipeline, images, tmp_path / "out", workers=4)
    assert [value is not None for value in matches.images(images)] == [True] * 6
    list(matches.each(list(itertools.combinations(images, 2))))
    assert sorted(described) == [path.name for path in images]


def test_an_image_or_a_pair_that_fails_harms_no_other(pipeline: Pipeline, images: list[Path], tmp_path: Path) -> None:
    images[1].write_bytes(b"no image")

    class Damaged(PhotographCameras):
        def given(self, paths: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> dict[str, Any]:
            return {"cameras": {"focal": torch.ones(7)} if paths[1] == images[5] else {}}

    matches = work(pipeline, images, tmp_path / "out", workers=2, cameras=Damaged())
    list(matches.each(list(itertools.combinations(images, 2))))
    assert (matches.done, matches.taken) == (6, 0)  # of four images
    assert sum("1.png" in trouble for trouble in matches.troubles) == 1
    assert sum("5.png" in trouble for trouble in matches.troubles) == 4


def test_workers_that_died_end_the_work(pipeline: Pipeline, images: list[Path], tmp_path: Path) -> None:
    matches = work(pipeline, images, tmp_path / "out", executor=Recorded(BrokenExecutor("killed")))
    with pytest.raises(BrokenExecutor, match="killed"):
        list(matches.each(list(itertools.combinations(images, 2))))
    assert matches.done == 0


def test_what_was_kept_before_an_end_is_taken(pipeline: Pipeline, images: list[Path], tmp_path: Path) -> None:
    pairs = list(itertools.combinations(images, 2))
    first = work(pipeline, images, tmp_path / "out", workers=2)
    for _ in itertools.islice(first.each(pairs), 4):
        pass
    again = work(pipeline, images, tmp_path / "out", workers=2)
    list(again.each(pairs))
    assert (again.taken, again.done) == (first.done, len(pairs) - first.done)
    assert again.related == len(pairs)
