"""A folder of images: the work on its images and pairs, by any workers, that can be resumed."""

from __future__ import annotations

import contextlib
import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from fmtorch.data.images import read_image
from fmtorch.data.pairs import ImageSource
from fmtorch.data.text_files import DataError
from fmtorch.jobs.execution import Execution
from fmtorch.jobs.pool import SHARED_BY, WorkerPool
from fmtorch.jobs.runner import Factory, Local, Source, TaskRunner, in_order
from fmtorch.jobs.threads import available, one_thread
from fmtorch.pipeline.exporting import exported_image, exported_match
from fmtorch.pipeline.folder_images import Pair, in_blocks
from fmtorch.pipeline.photograph_cameras import PhotographCameras
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.pipeline.two_images import Described, describe, relate
from fmtorch.storage.exchange.journal import ExportedPair, Journal

MEMORY = 64  # images whose features are kept for pairs to come
AHEAD = 4  # pairs a worker whose images are described before the first of them is matched
MAX_WORKERS = 8  # by default: each holds an image and its scale space
PRELOADED = ("fmtorch.pipeline.folder",)  # by the process that workers are forked of


class Photograph(NamedTuple):
    """An image to describe, as `read_image` and `describe` take it; in place of `image`, why there is none."""

    path: Path
    image: ImageSource | str
    longest_side: int
    orient: bool


class DescribedPair(NamedTuple):
    """Two described images to match. names: of them, in the journal. known: `PhotographCameras.given`."""

    pair: Pair
    ends: tuple[Described, Described]
    names: tuple[str, str]
    seed: int
    known: Mapping[str, Any]


def described_or_matched(pipeline: Pipeline, task: Photograph | DescribedPair) -> Described | ExportedPair | str:
    """What a worker does, by one thread: an image's features, what a journal keeps of a pair, or what went wrong."""
    try:
        with one_thread(pipeline.device):
            if isinstance(task, DescribedPair):
                result = relate(pipeline, *task.ends, task.seed, **task.known)
                return exported_match(task.names, task.ends, result)
            if isinstance(task.image, str):
                return task.image
            return describe(pipeline, read_image(task.image, orient=task.orient), task.longest_side)
    except Exception as error:  # one image, or one pair, does not end the work on the others
        return _in_a_line(error)


def _in_a_line(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]


def folder_workers(pipeline: Pipeline, execution: Execution | None = None) -> WorkerPool:
    """The workers for `FolderMatches`; of threads one a core, or one for a GPU, unless `execution` says how many."""
    execution = execution or Execution()
    if execution.shared:
        usual = min(available(), MAX_WORKERS) if pipeline.device.type == "cpu" else 1
        return WorkerPool(dataclasses.replace(execution, workers=execution.workers or usual))
    torch.multiprocessing.set_sharing_strategy(SHARED_BY)  # type: ignore[no-untyped-call]
    return WorkerPool(execution, PRELOADED)


class FolderMatches:
    """Matches pairs of images into a journal, which this process alone writes; what that has already is taken.

    workers: who does it, not closed at the end; None: those of `folder_workers`. build: makes the pipeline in other
    processes; None: threads share it. cameras: of the images.

    done, taken, related: pairs matched now, taken from the journal, and of either those that show one scene.
    """

    def __init__(
        self, pipeline: Pipeline, journal: Journal, longest_side: int, orient: bool, seed: int, *,
        workers: WorkerPool | None = None, build: Callable[[], Pipeline] | None = None,
        cameras: PhotographCameras | None = None,
    ) -> None:  # fmt: skip
        self.pipeline, self.journal, self.cameras = pipeline, journal, cameras or PhotographCameras()
        self.longest_side, self.orient, self.seed = longest_side, orient, seed
        self.workers = workers
        self.source: Source[Pipeline] = Local(pipeline) if build is None else Factory(build)
        self.done = self.taken = self.related = self._failed = 0
        self._troubles: dict[tuple[Path, ...], str] = {}
        self._described: OrderedDict[Path, Described | None] = OrderedDict()  # None: it cannot be

    @property
    def troubles(self) -> list[str]:
        """What went wrong with images and pairs, in the order of their names; they are tried again the next time."""
        return [trouble for _, trouble in sorted(self._troubles.items())]

    def images(self, images: Sequence[Path]) -> Iterator[Described | None]:
        """The features of images, in their order; None of one that cannot be read."""
        with self._pool() as pool:
            photographs = (self._photograph(image, pool) for image in images)
            for photograph, result in in_order(pool, self.source, described_or_matched, photographs):
                self._keep(photograph, result)
                yield self._described[photograph.path]
                self._forget(set())

    def each(self, pairs: Sequence[Pair]) -> Iterator[None]:
        """Match the pairs, keep what is found of each, and yield after it.

        Raises WorkersLost where workers die whatever they do, or a scheduler is gone.
        """
        before = self._passed
        with self._pool() as pool:
            runner = TaskRunner(pool, self.source, described_or_matched, self._keep, self._keep)
            for _ in runner.each(self._tasks(pairs, pool)):
                while before < self._passed:
                    before += 1
                    yield
        yield from [None] * (self._passed - before)

    @property
    def _passed(self) -> int:
        return self.done + self.taken + self._failed

    @contextlib.contextmanager
    def _pool(self) -> Iterator[WorkerPool]:
        if self.workers is not None:
            yield self.workers
            return
        with folder_workers(self.pipeline) as pool:
            yield pool

    def _tasks(self, pairs: Sequence[Pair], pool: WorkerPool) -> Iterator[Photograph | DescribedPair | None]:
        """Pairs as soon as their images are described, and before them these; None where others must end first."""
        todo = iter(in_blocks(pairs, MEMORY // 2))
        ahead = max(MEMORY // 2, AHEAD * pool.size)
        begun, describing = list[Pair](), set[Path]()
        while True:
            ready = next((pair for pair in begun if all(image in self._described for image in pair)), None)
            if ready is not None:
                begun.remove(ready)
                if (task := self._described_pair(ready)) is not None:
                    yield task
            elif len(begun) < ahead and (pair := next(todo, None)) is not None:
                if self.journal.has_pair(*pair):
                    self.taken += 1
                    self.related += self.journal.pair(*pair).related
                    continue
                begun.append(pair)
                describing -= self._described.keys()
                for image in pair:
                    if image in self._described:
                        self._described.move_to_end(image)
                    elif image not in describing:
                        describing.add(image)
                        yield self._photograph(image, pool)
                self._forget({image for pair in begun for image in pair})
            elif begun:
                yield None
            else:
                return

    def _photograph(self, image: Path, pool: WorkerPool) -> Photograph:
        try:
            source: ImageSource | str = self.cameras.source(image)
            if pool.execution.send_images:
                source = dataclasses.replace(source, data=image.read_bytes())  # type: ignore[type-var]
        except (DataError, OSError) as error:  # no camera, or no file
            source = _in_a_line(error)
        return Photograph(image, source, self.longest_side, self.orient)

    def _described_pair(self, pair: Pair) -> DescribedPair | None:
        """A pair to match; None where it cannot be."""
        end0, end1 = (self._described[image] for image in pair)
        if end0 is None or end1 is None:
            self._failed += 1
            return None
        names = self.journal.name(pair[0]), self.journal.name(pair[1])
        try:
            known = self.cameras.given(pair, [end0.size, end1.size])
        except Exception as error:
            self._fail(pair, _in_a_line(error))
            return None
        return DescribedPair(pair, (end0, end1), names, self.seed, known)

    def _keep(self, task: Photograph | DescribedPair, result: Any) -> None:
        """Store an image or a pair, or tell what went wrong with it."""
        if isinstance(task, Photograph):
            self._described[task.path] = self._keep_image(task.path, result)
            return
        if not isinstance(result, str):
            try:
                self.journal.add_pair(*task.pair, result)
            except Exception as error:
                result = _in_a_line(error)
        if isinstance(result, str):
            self._fail(task.pair, result)
        else:
            self.done += 1
            self.related += result.related

    def _keep_image(self, image: Path, described: Described | str) -> Described | None:
        if not isinstance(described, str):
            try:
                if not self.journal.has_image(image):
                    camera = self.cameras.of(image, described.size)
                    self.journal.add_image(image, exported_image(self.journal.name(image), described, camera))
                return described
            except Exception as error:
                described = _in_a_line(error)
        self._troubles[image,] = described
        return None

    def _fail(self, pair: Pair, reason: str) -> None:
        self._failed += 1
        self._troubles[pair] = f"{self.journal.name(pair[0])}, {self.journal.name(pair[1])}: {reason}"

    def _forget(self, needed: set[Path]) -> None:
        """Keep the features of the last images, and of those that are needed."""
        for image in [*self._described]:
            if len(self._described) <= MEMORY:
                return
            if image not in needed:
                del self._described[image]
