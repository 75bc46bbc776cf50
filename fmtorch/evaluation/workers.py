"""What works on batches of pairs: threads of this process, or processes of their own.

Threads share features and networks and start at once, but only one of them issues torch operations at a time: enough
where detectors, networks and OpenCV do the work. Processes use all cores for estimators too, at some seconds and some
hundred megabytes each.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import torch

from fmtorch.data.pairs import ImagePair, ImageSource
from fmtorch.evaluation.pair_cameras import WithPairCameras
from fmtorch.evaluation.rows import evaluate
from fmtorch.pipeline.configuration import compile_with
from fmtorch.pipeline.examination import examined
from fmtorch.pipeline.exporting import keep_outcomes
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.storage import PairRow
from fmtorch.storage.exchange.journal import Journal
from fmtorch.storage.features import CachedFeatures

Build = Callable[[], Pipeline]


@dataclass(frozen=True)
class Work:
    """The rows of a batch; computed, found: images whose features a process computed or took from the cache for it."""

    rows: list[PairRow]
    computed: int = 0
    found: int = 0


class Workers:
    """Evaluate batches of pairs, several at a time. One thread of torch's own each: contended ones collapse.

    build: makes the pipeline anew in each process; it is pickled. None: threads, which share `pipeline`.
    """

    def __init__(self, pipeline: Pipeline, workers: int, build: Build | None = None) -> None:
        self.size = workers
        self.pipeline = None if build else pipeline
        self.executor: Executor
        if build is None:
            self.executor = ThreadPoolExecutor(workers)
        else:
            self.executor = ProcessPoolExecutor(
                workers, multiprocessing.get_context("spawn"), initializer=_begin, initargs=(build,)
            )

    def submit(self, pairs: list[ImagePair], seed: int, journal: Journal | None = None) -> Future[Work]:
        """The rows of these pairs, some time. journal: keeps keypoints, matches and F of them too."""
        if self.pipeline is None:
            return self.executor.submit(_in_process, pairs, seed, journal)
        return self.executor.submit(_work, self.pipeline, pairs, seed, journal)

    def submit_features(self, image: ImageSource) -> Future[None]:
        """Have a thread compute an image's features, for the pipeline to keep; its pairs will tell what that raises."""
        assert self.pipeline is not None, "processes share no features"
        return self.executor.submit(_keep_features, self.pipeline, image)

    def close(self) -> None:
        """Wait for what is under way; what has not begun is dropped."""
        self.executor.shutdown(wait=True, cancel_futures=True)


def _work(pipeline: Pipeline, pairs: list[ImagePair], seed: int, journal: Journal | None) -> Work:
    compile_with([*pipeline.pruners.values(), pipeline.estimator])
    knowledge = pipeline.estimator.given if isinstance(pipeline.estimator, WithPairCameras) else None
    outcomes = examined(pipeline, pipeline.run(pairs, seed), seed, knowledge)
    if journal is not None:
        keep_outcomes(journal, pipeline, outcomes)
    return Work(evaluate(outcomes, seed))


def _keep_features(pipeline: Pipeline, image: ImageSource) -> None:
    with contextlib.suppress(Exception):
        pipeline.features(image)


def end_with_parent() -> None:
    """Have this process end when the one that started it does, however that does: a worker would wait forever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


_mine: Pipeline | None = None  # of a process that works for another


def _begin(build: Build) -> None:
    """The start of a process: an interrupt is for the one that asked, which waits for what is under way."""
    global _mine
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    _mine = build()


def _in_process(pairs: list[ImagePair], seed: int, journal: Journal | None) -> Work:
    assert _mine is not None
    extractor = _mine.extractor
    if not isinstance(extractor, CachedFeatures):
        return _work(_mine, pairs, seed, journal)
    computed, cached = extractor.computed, extractor.found
    rows = _work(_mine, pairs, seed, journal).rows
    return Work(rows, extractor.computed - computed, extractor.found - cached)
