"""What a worker does with a batch of pairs: it runs a pipeline and evaluates its outcomes.

Threads share features and networks and start at once, but only one of them issues torch operations at a time: enough
where detectors, networks and OpenCV do the work. Processes use all cores for estimators too, at some seconds and some
hundred megabytes each. Rows and exports come back to the caller, who alone writes.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

from fmtorch.data.pairs import GivenMatches, ImagePair, ImageSource
from fmtorch.evaluation.pair_cameras import PairCameras, WithPairCameras
from fmtorch.evaluation.rows import evaluate
from fmtorch.pipeline.examination import examined
from fmtorch.pipeline.exporting import keep_outcomes
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from fmtorch.storage import PairRow
from fmtorch.storage.exchange.collected import CollectedJournal
from fmtorch.storage.features import CachedFeatures
from fmtorch.two_view.pair_type import compile_with

Build = Callable[[], Pipeline]


@dataclasses.dataclass(frozen=True)
class Batch:
    """Pairs to evaluate.

    cameras: of their keys, for a pipeline that was built without them. journal: an empty one, where keypoints, matches
    and F are to be exported. counted: whether the worker counts the images that it computed. signed: of `pose_errors`.
    """

    pairs: list[ImagePair]
    seed: int
    cameras: Mapping[int, PairCameras] | None = None
    journal: CollectedJournal | None = None
    counted: bool = False
    signed: bool = False


@dataclasses.dataclass(frozen=True)
class Work:
    """The rows of a batch.

    computed, from_cache: images whose features a process computed or took from the cache for it.
    """

    rows: list[PairRow]
    computed: int = 0
    from_cache: int = 0
    journal: CollectedJournal | None = None


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
    if batch.journal is not None:
        keep_outcomes(batch.journal, pipeline, outcomes)
    rows = evaluate(outcomes, batch.seed, batch.signed)
    if batch.cameras is not None and isinstance(pipeline.estimator, WithPairCameras):
        for key in batch.cameras:
            pipeline.estimator.cameras.pop(key, None)
    counts = (cache.computed - computed, cache.found - from_cache) if cache else (0, 0)
    return Work(rows, *counts, batch.journal)


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
