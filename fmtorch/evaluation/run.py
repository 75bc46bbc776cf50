"""The loop that makes a run: batches of pairs through a pipeline by several workers, rows stored as they come."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import torch

from fmtorch.data.pairs import ImagePair, ImageSource
from fmtorch.evaluation.workers import Build, Work, Workers
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.storage import PairRow
from fmtorch.storage.exchange.journal import Journal
from fmtorch.storage.features import CachedFeatures

BATCHES_OF_A_WORKER = 4  # at least, where there are pairs enough


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
    workers: int,
    store: Callable[[list[PairRow]], None],
    build: Build | None = None,
    journal: Journal | None = None,
) -> Iterator[int]:
    """Run and evaluate the pairs, hand each batch's rows to `store`, and yield how many pairs it held.

    build: makes the same pipeline in another process: workers are then processes, otherwise threads (see `Workers`).
    journal: keeps keypoints, matches and F for an export.
    Results do not depend on `batch`, `workers` or `build`. Raises RuntimeError where a process dies.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    batch = _shared_out(len(pairs), batch, workers)
    team = Workers(pipeline, max(1, min(workers, -(-len(pairs) // batch))), build)
    waiting: set[Future[Work]] = set()

    def kept(future: Future[Work]) -> int:
        work = future.result()
        store(work.rows)
        if isinstance(pipeline.extractor, CachedFeatures):
            pipeline.extractor.computed += work.computed
            pipeline.extractor.found += work.found
        return len(work.rows)

    try:
        begun = 0
        if build is None and team.size > 1:
            begun = 1  # alone: where its stages compile kernels, others would wait for them
            waiting.add(first := team.submit([pairs[0]], seed, journal))
            _features_ahead(team, pipeline.memory, pairs, first)
        todo = (list(pairs[i : i + batch]) for i in range(begun, len(pairs), batch))
        while True:
            for batch_of_pairs in todo:
                waiting.add(team.submit(batch_of_pairs, seed, journal))
                if len(waiting) > workers:
                    break
            if not waiting:
                return
            finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in finished:
                yield kept(future)
    except BrokenProcessPool as error:
        raise RuntimeError(
            "a worker process ended before its time, perhaps for want of memory: the same command goes on from here; "
            "workers=1 or processes=false need less of it"
        ) from error
    finally:  # interrupted: what is under way is finished and kept
        team.close()
        for future in waiting:
            if not future.cancelled() and future.exception() is None:
                kept(future)
        torch.set_num_threads(before)


def _features_ahead(team: Workers, memory: int, pairs: Sequence[ImagePair], first: Future[Work]) -> None:
    """While a worker is at the first pair, the others compute features of those that follow, as many as are kept."""
    computing: set[Future[None]] = set()
    for image in itertools.islice(_images_after_the_first(pairs), memory):
        while len(computing) >= team.size - 1 and not first.done():
            wait(list[Future[Any]]([first, *computing]), return_when=FIRST_COMPLETED)
            computing = {future for future in computing if not future.done()}
        if first.done():
            return
        computing.add(team.submit_features(image))


def _images_after_the_first(pairs: Sequence[ImagePair]) -> Iterator[ImageSource]:
    """The images that pairs show, each once, without those of the first pair."""
    seen = {pairs[0].image0.path, pairs[0].image1.path}
    for pair in pairs[1:]:
        if pair.problem is None and pair.matches is None:
            for image in (pair.image0, pair.image1):
                if image.path not in seen:
                    seen.add(image.path)
                    yield image


def _shared_out(pairs: int, batch: int, workers: int) -> int:
    """The size of a batch of so many pairs that no one of several workers is long alone at the end."""
    return batch if workers == 1 else max(1, min(batch, -(-pairs // (BATCHES_OF_A_WORKER * workers))))
