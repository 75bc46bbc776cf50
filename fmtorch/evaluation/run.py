"""What a worker does with a batch of pairs: it runs a pipeline and evaluates its outcomes.

Threads share features and networks and start at once, but only one of them issues torch operations at a time: enough
where detectors, networks and OpenCV do the work. Processes use all cores for estimators too, at some seconds and some
hundred megabytes each. Rows and exports come back to the caller, who alone writes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path
from typing import Any

import torch

from fmtorch.core.stages import ImageMatcher
from fmtorch.data.pairs import GivenMatches, ImagePair, ImageSource
from fmtorch.evaluation.pair_cameras import PairCameras, WithPairCameras
from fmtorch.evaluation.rows import evaluate
from fmtorch.io.match_store import MatchRecords, MatchStore
from fmtorch.jobs.execution import Execution
from fmtorch.jobs.pool import WorkerPool
from fmtorch.jobs.runner import Factory, Local, Source, TaskRunner
from fmtorch.pipeline.exporting import match_records
from fmtorch.pipeline.pipeline import Outcome, Pipeline, examined
from fmtorch.runs import PairRow
from fmtorch.runs.feature_cache import CachedFeatures
from fmtorch.two_view.pair_type import compile_with

Build = Callable[[], Pipeline]


@dataclasses.dataclass(frozen=True)
class Batch:
    """Pairs to evaluate.

    cameras: of their keys, for a pipeline that was built without them. export: whether keypoints, matches and F are to
    be exported. counted: whether the worker counts the images that it computed. signed: of `pose_errors`.
    """

    pairs: list[ImagePair]
    seed: int
    cameras: Mapping[int, PairCameras] | None = None
    export: bool = False
    counted: bool = False
    signed: bool = False


@dataclasses.dataclass(frozen=True)
class Work:
    """The rows of a batch.

    computed, from_cache: images whose features a process computed or took from the cache for it. tracebacks: of
    `Pipeline.tracebacks`.
    """

    rows: list[PairRow]
    computed: int = 0
    from_cache: int = 0
    records: MatchRecords | None = None
    tracebacks: Mapping[str, str] = dataclasses.field(default_factory=dict)


def evaluate_batch(pipeline: Pipeline, batch: Batch) -> Work:
    """The rows of a batch, and what is to be exported of it."""
    cache = pipeline.extractor if batch.counted and isinstance(pipeline.extractor, CachedFeatures) else None
    computed, from_cache = (cache.computed, cache.found) if cache else (0, 0)
    if batch.cameras is not None:
        assert isinstance(pipeline.estimator, WithPairCameras)
        pipeline.estimator.cameras |= batch.cameras
    compile_with([*pipeline.pruners.values(), pipeline.estimator])
    knowledge = pipeline.estimator.given if isinstance(pipeline.estimator, WithPairCameras) else None
    outcomes = examined(pipeline, pipeline.run(batch.pairs, batch.seed), batch.seed, knowledge)
    records = match_records(pipeline, outcomes) if batch.export else None
    rows = evaluate(outcomes, batch.seed, batch.signed)
    if batch.cameras is not None and isinstance(pipeline.estimator, WithPairCameras):
        for key in batch.cameras:
            pipeline.estimator.cameras.pop(key, None)
    counts = (cache.computed - computed, cache.found - from_cache) if cache else (0, 0)
    return Work(rows, *counts, records, dict(pipeline.tracebacks))


def divided(batch: Batch) -> list[Batch]:
    """The pairs of a batch in batches of their own."""
    return [dataclasses.replace(batch, pairs=[pair]) for pair in batch.pairs]


def failed(batch: Batch, reason: str) -> list[PairRow]:
    """The rows of pairs that no worker lives to evaluate."""
    return evaluate([Outcome(pair, reason=reason) for pair in batch.pairs], batch.seed, batch.signed)


def compute_features(pipeline: Pipeline, image: ImageSource) -> None:
    """Have an image's features computed for the pipeline to keep; its pairs will tell what that raises."""
    with contextlib.suppress(Exception):
        pipeline.features(image)


def with_contents(pair: ImagePair) -> ImagePair:
    """The pair with its images as bytes, or its given matches read; what cannot be read the worker will tell."""
    if pair.problem is not None:
        return pair
    with contextlib.suppress(Exception):
        if pair.matches is not None:
            return dataclasses.replace(pair, matches=_Read(pair.matches()))
        images = (dataclasses.replace(image, data=image.path.read_bytes()) for image in (pair.image0, pair.image1))
        return dataclasses.replace(pair, image0=next(images), image1=next(images))
    return pair


@dataclasses.dataclass(frozen=True)
class _Read:
    """Given matches that are read already."""

    matches: GivenMatches

    def __call__(self) -> GivenMatches:
        return self.matches


def batch_contents(pairs: list[ImagePair]) -> list[ImagePair]:
    """`with_contents` of each pair; an image that several show is read, and sent, once."""
    held: dict[Path, bytes | None] = {}
    result = []
    for pair in pairs:
        own = with_contents(pair)
        images = [
            image if image.data is None else dataclasses.replace(image, data=held.setdefault(image.path, image.data))
            for image in (own.image0, own.image1)
        ]
        result.append(dataclasses.replace(own, image0=images[0], image1=images[1]))
    return result


# The loop that makes a run: batches of pairs through a pipeline by several workers, rows stored as they come


BATCHES_OF_A_WORKER = 4  # at least, where there are pairs enough
PRELOADED = ("fmtorch.evaluation.run",)  # by the process that workers are forked of


def select(pairs: Sequence[ImagePair], limit: int | None) -> list[ImagePair]:
    """The pairs, ordered so that those that share images follow one another; with a limit, that many of each family.

    The limited choice is by the pairs' keys: spread over the scenes, and a smaller one is part of a larger one.
    """
    chosen = list(pairs)
    if limit is not None:
        families: dict[str, list[ImagePair]] = {}
        for pair in sorted(chosen, key=lambda pair: pair.key):
            families.setdefault(pair.family, []).append(pair)
        chosen = [pair for family in families.values() for pair in family[:limit]]
    return sorted(chosen, key=lambda pair: (pair.family, pair.scene, pair.image0.identity, pair.image1.identity))


def evaluate_pairs(
    pipeline: Pipeline,
    pairs: Sequence[ImagePair],
    *,
    seed: int,
    batch: int,
    execution: Execution,
    store: Callable[[list[PairRow]], None],
    build: Build | None = None,
    cameras: Mapping[int, PairCameras] | None = None,
    journal: MatchStore | None = None,
    signed: bool = False,
) -> Iterator[int]:
    """Run and evaluate the pairs, hand each batch's rows to `store`, and yield how many pairs it held.

    execution: by which workers. build: makes the same pipeline in another process, where these are no threads.
    cameras: what a pipeline that `build` makes is given of the pairs' cameras, see `built_with`.
    journal: keeps keypoints, matches and F for an export. signed: of `pose_errors`.
    Rows and journal are written here. Results do not depend on `batch` or `execution`. Raises WorkersLost where workers
    die whatever they do, or a scheduler is gone.
    """
    pool = WorkerPool(execution, PRELOADED, limit=max(1, len(pairs)))
    batch = _shared_out(len(pairs), batch, pool.size)
    source: Source[Pipeline] = Local(pipeline) if execution.shared or build is None else Factory(build)

    def given(members: Sequence[ImagePair]) -> Batch:
        own = None if cameras is None or source.shared else {p.key: cameras[p.key] for p in members if p.key in cameras}
        sent = batch_contents(list(members)) if execution.send_images and not source.shared else list(members)
        return Batch(sent, seed, own, journal is not None, not source.shared, signed)

    def keep(done: Batch, work: Work) -> None:
        if journal is not None and work.records is not None:
            journal.add(work.records)
        store(work.rows)
        pipeline.tracebacks |= work.tracebacks
        if isinstance(pipeline.extractor, CachedFeatures):
            pipeline.extractor.computed += work.computed
            pipeline.extractor.found += work.from_cache

    runner = TaskRunner(pool, source, evaluate_batch, keep, lambda done, reason: store(failed(done, reason)), divided)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with pool:
            begun = 0
            if source.shared and pool.size > 1 and pairs and not isinstance(pipeline.matcher, ImageMatcher):
                begun = 1  # alone: where its stages compile kernels, others would wait for them
                _features_ahead(pool, pipeline, pairs, runner.begin(given(pairs[:1])))
            for done in runner.each(given(pairs[i : i + batch]) for i in range(begun, len(pairs), batch)):
                yield len(done.pairs)
    finally:
        torch.set_num_threads(before)


def _features_ahead(pool: WorkerPool, pipeline: Pipeline, pairs: Sequence[ImagePair], first: Future[Work]) -> None:
    """While a worker is at the first pair, the others compute features of those that follow, as many as are kept."""
    computing: set[Future[None]] = set()
    for image in itertools.islice(_images_after_the_first(pairs), pipeline.memory):
        while len(computing) >= pool.size - 1 and not first.done():
            wait(list[Future[Any]]([first, *computing]), return_when=FIRST_COMPLETED)
            computing = {future for future in computing if not future.done()}
        if first.done():
            return
        computing.add(pool.executor.submit(compute_features, pipeline, image))


def _images_after_the_first(pairs: Sequence[ImagePair]) -> Iterator[ImageSource]:
    """The images that pairs show, each once, without those of the first pair."""
    seen = {pairs[0].image0.pixels, pairs[0].image1.pixels}
    for pair in pairs[1:]:
        if pair.problem is None and pair.matches is None:
            for image in (pair.image0, pair.image1):
                if image.pixels not in seen:
                    seen.add(image.pixels)
                    yield image


def _shared_out(pairs: int, batch: int, workers: int) -> int:
    """The size of a batch of so many pairs that no one of several workers is long alone at the end."""
    return batch if workers == 1 else max(1, min(batch, -(-pairs // (BATCHES_OF_A_WORKER * workers))))
