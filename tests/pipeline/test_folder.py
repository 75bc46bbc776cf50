"""Folders of photographs: what is matched, kept, resumed; images that are alike."""

import itertools
import json
import os
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

from fmtorch.core import Features
from fmtorch.data import ImageSource
from fmtorch.io import MatchStore
from fmtorch.jobs import DEATH, Execution, WorkerPool, WorkersLost
from fmtorch.pipeline import FolderMatches, Pipeline, chosen_pairs, folder, folder_workers, images_below
from tests.data.native import write_image as picture
from tests.helpers import draw, write_file
from tests.jobs.work import fatal_pipeline, sift_pipeline


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


@pytest.fixture
def pipeline() -> Pipeline:
    return sift_pipeline()


@pytest.fixture
def images(tmp_path: Path) -> list[Path]:
    return [draw(tmp_path / "photos" / f"{i}.png", 0, shift=16 * i).path for i in range(6)]


def work(pipeline, images, output, workers=None, **options) -> FolderMatches:
    workers = workers or folder_workers(pipeline)
    return FolderMatches(pipeline, MatchStore(output, images[0].parent), workers, 1600, True, 0, **options)


def kept(output: Path) -> dict[str, dict[str, Any]]:
    return {path.name: dict(np.load(path)) for path in sorted(output.rglob("*.npz"))}


def test_any_number_of_workers_and_any_executor_keep_the_same(pipeline, images, tmp_path):
    pairs = list(itertools.combinations(images[:4], 2))
    executor = Recorded()
    own = Execution(workers=1, make=lambda: executor)
    for name, execution in {"one": threads(1), "three": threads(3), "own": own}.items():
        with WorkerPool(execution) as workers:
            matches = work(pipeline, images, tmp_path / name, workers=workers)
            assert len(list(matches.each(pairs))) == matches.done == len(pairs)
            assert matches.troubles == []
    assert Counter(executor.calls) == {"ImageToDescribe": 4, "DescribedPair": 6}
    assert len(kept(tmp_path / "one")) == 10
    for name in ("three", "own"):
        np.testing.assert_equal(kept(tmp_path / name), kept(tmp_path / "one"))


@pytest.mark.parametrize("send", [False, True])
def test_processes_keep_the_same(pipeline: Pipeline, images: list[Path], tmp_path: Path, send: bool) -> None:
    pairs = list(itertools.combinations(images[:4], 2))
    list(work(pipeline, images, tmp_path / "threads").each(pairs))
    with folder_workers(pipeline, Execution("processes", 2, send_images=send)) as workers:
        matches = work(pipeline, images, tmp_path / "processes", workers=workers, build=sift_pipeline)
        list(matches.each(pairs))
    assert (matches.done, matches.troubles) == (6, [])
    np.testing.assert_equal(kept(tmp_path / "processes"), kept(tmp_path / "threads"))


def test_no_image_is_described_twice(pipeline, images, tmp_path, monkeypatch):
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

    class Damaged(folder.PhotographCameras):
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


def test_an_image_that_ends_its_workers_is_reported_and_the_others_are_matched(pipeline, images, tmp_path):
    assert cv2.imwrite(str(images[1]), np.zeros((240, 320), np.uint8))
    with folder_workers(pipeline, Execution("processes", 1)) as workers:
        matches = work(pipeline, images[:4], tmp_path / "out", workers=workers, build=fatal_pipeline)
        assert len(list(matches.each(list(itertools.combinations(images[:4], 2))))) == 6
    assert (matches.done, matches.troubles) == (3, [DEATH])


def test_more_images_than_are_held_in_memory(pipeline, images, tmp_path, monkeypatch):
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


def test_nothing_that_fmtorch_has_written_is_a_photograph(tmp_path: Path) -> None:
    photographs = [picture(tmp_path / name) for name in ("a.jpg", "b.png", "more/c.tif", "more/matches.png")]
    for name in ("matches.png", "pruning.png", "epipolar.png"):
        picture(tmp_path / "matches/a-b" / name)
        picture(tmp_path / name)  # output=.
    for place in ("matches/a-b", "."):
        write_file(tmp_path / place / "result.json", "{}")
    picture(tmp_path / "set/scene/Images/00000000.jpg")  # an undistorted copy
    write_file(tmp_path / "set/pairs.json", "{}")
    picture(tmp_path / ".thumbnails/a.jpg")
    assert images_below(tmp_path) == sorted(photographs)
    assert images_below(tmp_path / "matches/..") != []


def test_a_set_of_pairs_may_be_asked_for(tmp_path: Path) -> None:
    write_file(tmp_path / "pairs.json", "{}")
    images = [picture(tmp_path / f"scene/Images/{i}.jpg") for i in range(2)]
    assert images_below(tmp_path) == images


def test_only_regular_files_are_images(tmp_path: Path) -> None:
    images = [picture(tmp_path / "a.jpg"), picture(tmp_path / "b.jpg")]
    os.mkfifo(tmp_path / "c.jpg")
    (tmp_path / "d.jpg").symlink_to("/dev/zero")
    assert images_below(tmp_path) == images


def test_sequential_pairs_follow_the_natural_order_of_names(tmp_path: Path) -> None:
    for i in (1, 2, 9, 10, 11):
        picture(tmp_path / f"frame{i}.jpg")
    images = images_below(tmp_path)
    pairs = chosen_pairs(tmp_path, images, Path("sequential:2"))
    numbers = [tuple(int(image.stem.removeprefix("frame")) for image in pair) for pair in pairs]
    assert numbers == [(1, 2), (1, 9), (2, 9), (2, 10), (9, 10), (9, 11), (10, 11)]
    assert len(chosen_pairs(tmp_path, images, Path("sequential:100"))) == 10
    for wrong in ("", ":0", ":-1", ":x", ":1.5"):
        with pytest.raises(ValueError, match="it must be sequential:N with a whole number N of at least 1"):
            chosen_pairs(tmp_path, images, Path(f"sequential{wrong}"))


def test_folders_of_one_name_have_outputs_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert folder.default_output(tmp_path / "x/photos") == Path("matches/photos")
    write_file(tmp_path / "matches/photos/export.json", json.dumps({"images": str(tmp_path / "x/photos")}))
    assert folder.default_output(Path("x/photos")) == Path("matches/photos")
    other = folder.default_output(tmp_path / "y/photos")
    assert other.name.startswith("photos-")
    assert other != folder.default_output(tmp_path / "z/photos")


def paths(n: int) -> list[Path]:
    return [Path(f"{i}.jpg") for i in range(n)]


@pytest.mark.parametrize("rows", [1, 3, 1024])
@pytest.mark.parametrize("count", [1, 2, 50])
def test_each_image_with_its_most_similar_ones(count: int, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folder, "ROWS", rows)
    generator = torch.Generator().manual_seed(0)
    vectors = torch.nn.functional.normalize(torch.randn(9, 5, generator=generator).double(), dim=1)
    vectors[4] = 0  # an image that could not be read
    expected = set()
    for i in range(9):
        others = [j for j in range(9) if j not in (i, 4) and i != 4]
        others.sort(key=lambda j: (-float(np.dot(vectors[i].numpy(), vectors[j].numpy())), j))
        expected |= {(min(i, j), max(i, j)) for j in others[:count]}
    images = paths(9)
    assert folder.similar_pairs(images, vectors, count) == [(images[i], images[j]) for i, j in sorted(expected)]


def test_equally_similar_images_come_by_number() -> None:
    assert folder.similar_pairs(paths(4), torch.ones(4, 1), 1) == [(Path("0.jpg"), Path(f"{i}.jpg")) for i in (1, 2, 3)]


def test_an_image_that_cannot_be_read_has_no_vector() -> None:
    features = Features(torch.zeros(2, 2, 3), torch.zeros(2), torch.ones(2, 7), torch.tensor([4, 4]))
    described = folder.Described(features, torch.ones(2), (4, 4), 0.0)
    vectors = folder.vectors_of([None, described], lambda descriptors: descriptors[0])
    assert vectors.tolist() == [[0.0] * 7, [1.0] * 7]
    assert folder.vectors_of([None], lambda descriptors: descriptors[0]).shape == (1, 1)
