"""Workers that evaluate batches of pairs: threads that share features, and processes."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fmtorch.core import Correspondences, Estimate, Features
from fmtorch.data import ImagePair, ImageSource
from fmtorch.evaluation import evaluate_pairs
from fmtorch.jobs import Execution, WorkersLost
from fmtorch.pipeline import Pipeline, load_pipeline
from fmtorch.runs import PairRow

ONE, TWO = (Execution("threads", count) for count in (1, 2))


def _ends() -> Pipeline:
    os._exit(3)


def test_a_process_that_ends_is_told() -> None:
    images = [ImageSource(f"scene/{i}", Path(f"{i}.png")) for i in range(3)]
    pairs = [ImagePair(f"scene/0-{i}", "family", "scene", images[0], images[i], np.eye(3)) for i in (1, 2)]
    rows: list[PairRow] = []
    run = evaluate_pairs(
        load_pipeline("sift_ratio"), pairs, seed=0, batch=1, execution=Execution("processes", 2),
        store=rows.extend, build=_ends,
    )  # fmt: skip
    with pytest.raises(WorkersLost, match="the same command goes on"):
        list(run)
    assert rows == []


WORKER = """
import multiprocessing, time
from fmtorch.jobs.runner import end_with_parent
def work():
    end_with_parent()
    print(multiprocessing.current_process().pid, flush=True)
    time.sleep(300)
multiprocessing.get_context("fork").Process(target=work).start()
time.sleep(300)
"""


def test_a_worker_ends_with_the_process_that_was_killed() -> None:
    parent = subprocess.Popen([sys.executable, "-c", WORKER], stdout=subprocess.PIPE, text=True)
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 60
    while alive(worker) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not alive(worker)


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits to be buried does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


class Watched:
    """A pipeline's stages that note what is called when; the first estimation waits until others have computed."""

    def __init__(self, pipeline: Pipeline, images: int) -> None:
        self.images, self.enough = images, threading.Event()
        self.extracted: list[int] = []
        self.at_first_estimate = -1
        self.extractor, self.estimator = pipeline.extractor, pipeline.estimator
        pipeline.extractor = self.extract  # type: ignore[assignment]
        pipeline.estimator = self.estimate  # type: ignore[assignment]

    def extract(self, image: NDArray[np.uint8]) -> Features:
        features = self.extractor(image)
        self.extracted.append(int(image.sum()))
        if len(self.extracted) >= self.images:
            self.enough.set()
        return features

    def estimate(self, c: Correspondences, seed: int) -> Estimate:
        if self.at_first_estimate < 0:
            self.enough.wait(60)
            self.at_first_estimate = len(self.extracted)
        return self.estimator(c, seed)


def textured(path: Path, seed: int) -> Path:
    noise = np.random.default_rng(seed).integers(0, 255, (60, 80), dtype=np.uint8)
    cv2.imwrite(str(path), cv2.resize(noise, (240, 180)))
    return path


def test_features_are_computed_while_the_first_pair_is_worked_on(tmp_path: Path) -> None:
    images = [ImageSource(f"scene/{i}", textured(tmp_path / f"{i}.png", i)) for i in range(7)]
    bad = ImageSource("scene/bad", tmp_path / "absent.png")
    pairs = [ImagePair(f"scene/0-{i}", "family", "scene", images[0], images[i], np.eye(3)) for i in range(1, 7)]
    pairs.insert(2, ImagePair("scene/0-bad", "family", "scene", images[0], bad, np.eye(3)))
    expected: list[PairRow] = []
    list(
        evaluate_pairs(
            load_pipeline("sift_ratio"),
            pairs,
            seed=0,
            batch=2,
            execution=Execution("threads", 1),
            store=expected.extend,
        )
    )
    pipeline, rows = load_pipeline("sift_ratio"), list[PairRow]()
    watched = Watched(pipeline, len(images))
    counts = list(evaluate_pairs(pipeline, pairs, seed=0, batch=2, execution=TWO, store=rows.extend))
    assert watched.at_first_estimate == len(images)  # all of them, while the first pair waited
    assert len(watched.extracted) == len(set(watched.extracted)) == len(images)  # each once
    assert sum(counts) == len(pairs)
    by_pair = {row.pair: (row.nsgd, row.reason) for row in rows}
    assert by_pair == {row.pair: (row.nsgd, row.reason) for row in expected}
    assert "absent.png" in by_pair["scene/0-bad"][1]
