import itertools
import os
import signal
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

from fmtorch.data import ImageSource
from fmtorch.io import MatchStore
from fmtorch.jobs import DEATH, Execution, WorkerPool, WorkersLost
from fmtorch.pipeline import FolderMatches, PhotographCameras, Pipeline, folder, folder_workers, load_pipeline


class Recorded(Executor):
    """An executor of one's own, which does what is submitted at once and records the kinds of tasks."""

    def __init__(self, error: Exception | None = None) -> None:
        self.calls: list[str] = []
        self.error = error

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.calls.append(type(args[0]).__name__)
        future: Future[Any] = Future()
        try:
            if self.error is not None:
                raise self.error
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def threads(count: int) -> Execution:
    return Execution("threads", count)


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
    return FolderMatches(pipeline, MatchStore(output, images[0].parent), 1600, True, 0, **options)


def kept(output: Path) -> dict[str, dict[str, Any]]:
    files = sorted(output.rglob("*.npz"))
    return {path.name: dict(np.load(path)) for path in files}


def test_any_number_of_workers_and_any_executor_keep_the_same(
    pipeline: Pipeline, images: list[Path], tmp_path: Path
) -> None:
    pairs = list(itertools.combinations(images, 2))
    executor = Recorded()
    own = Execution(workers=1, make=lambda: executor)
    for name, execution in {"one": threads(1), "three": threads(3), "own": own}.items():
        with WorkerPool(execution) as workers:
            matches = work(pipeline, images, tmp_path / name, workers=workers)
            assert len(list(matches.each(pairs))) == matches.done == len(pairs)
            assert matches.troubles == []
    assert Counter(executor.calls) == {"Photograph": 6, "DescribedPair": 15}
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
    with folder_workers(pipeline, Execution("processes", 2, send_images=send)) as workers:
        matches = work(pipeline, images, tmp_path / "processes", workers=workers, build=built)
        list(matches.each(pairs))
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
    with WorkerPool(threads(4)) as workers:
        matches = work(pipeline, images, tmp_path / "out", workers=workers)
        assert [value is not None for value in matches.images(images)] == [True] * 6
        list(matches.each(list(itertools.combinations(images, 2))))
    assert sorted(described) == [path.name for path in images]


def test_an_image_or_a_pair_that_fails_harms_no_other(pipeline: Pipeline, images: list[Path], tmp_path: Path) -> None:
    images[1].write_bytes(b"no image")

    class Damaged(PhotographCameras):
        def given(self, paths: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> dict[str, Any]:
            return {"cameras": {"focal": torch.ones(7)} if paths[1] == images[5] else {}}

    matches = work(pipeline, images, tmp_path / "out", cameras=Damaged())
    assert len(list(matches.each(list(itertools.combinations(images, 2))))) == 15
    assert (matches.done, matches.taken) == (6, 0)  # of four images
    assert sum("1.png" in trouble for trouble in matches.troubles) == 1
    assert sum("5.png" in trouble for trouble in matches.troubles) == 4


def test_workers_that_died_end_the_work(pipeline: Pipeline, images: list[Path], tmp_path: Path) -> None:
    dying = Execution(make=lambda: Recorded(BrokenExecutor("killed")))
    with WorkerPool(dying) as workers, pytest.raises(WorkersLost, match="the same command goes on from here"):
        list(work(pipeline, images, tmp_path / "out", workers=workers).each(list(itertools.combinations(images, 2))))
    assert kept(tmp_path / "out") == {}


class Fatal:
    """An extractor that ends its process at the darkest image."""

    def __init__(self, extractor: Any) -> None:
        self.extractor = extractor

    def __call__(self, image: Any) -> Any:
        if not image.any():
            os.kill(os.getpid(), signal.SIGKILL)
        return self.extractor(image)


def fatal() -> Pipeline:
    pipeline = built()
    pipeline.extractor = Fatal(pipeline.extractor)
    return pipeline


def test_an_image_that_ends_its_workers_is_told_and_the_others_are_matched(
    pipeline: Pipeline, images: list[Path], tmp_path: Path
) -> None:
    assert cv2.imwrite(str(images[1]), np.zeros((240, 320), np.uint8))
    with folder_workers(pipeline, Execution("processes", 2)) as workers:
        matches = work(pipeline, images[:4], tmp_path / "out", workers=workers, build=fatal)
        assert len(list(matches.each(list(itertools.combinations(images[:4], 2))))) == 6
    assert matches.done == 3
    assert matches.troubles == [DEATH]


def test_more_images_than_are_held_in_memory(
    pipeline: Pipeline, images: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folder, "MEMORY", 2)
    monkeypatch.setattr(folder, "AHEAD", 1)
    with WorkerPool(threads(2)) as workers:
        matches = work(pipeline, images, tmp_path / "out", workers=workers)
        held = [len(matches._described) for _ in matches.each(list(itertools.combinations(images, 2)))]
    assert (matches.done, matches.troubles) == (15, [])
    assert max(held) <= 2 * 2 + 1  # images of a pair a worker, and one that was described last


def test_what_was_kept_before_an_end_is_taken(pipeline: Pipeline, images: list[Path], tmp_path: Path) -> None:
    pairs = list(itertools.combinations(images, 2))
    first = work(pipeline, images, tmp_path / "out")
    for _ in itertools.islice(first.each(pairs), 4):
        pass
    again = work(pipeline, images, tmp_path / "out")
    list(again.each(pairs))
    assert (again.taken, again.done) == (first.done, len(pairs) - first.done)
    assert again.related == len(pairs)
