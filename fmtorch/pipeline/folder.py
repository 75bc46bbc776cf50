"""A folder of images: the work on its images and pairs, by any executor, that can be resumed."""

from __future__ import annotations

import contextlib
import dataclasses
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, NamedTuple

from fmtorch.core.recipes import Here, Recipe, Source
from fmtorch.core.threads import available, one_thread
from fmtorch.data.images import read_image
from fmtorch.data.pairs import ImageSource
from fmtorch.data.text_files import DataError
from fmtorch.pipeline.exporting import exported_image, exported_match
from fmtorch.pipeline.folder_images import Pair, in_blocks
from fmtorch.pipeline.photograph_cameras import PhotographCameras
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.pipeline.two_images import Described, describe, relate
from fmtorch.storage.exchange.journal import ExportedPair, Journal

MEMORY = 64  # images whose features are kept for pairs to come
AHEAD = 4  # pairs a worker that are begun before the first of them has ended
MAX_WORKERS = 8  # by default: each holds an image and its scale space


class Photograph(NamedTuple):
    """An image to describe, as `read_image` and `describe` take it."""

    image: ImageSource
    longest_side: int
    orient: bool


class DescribedPair(NamedTuple):
    """Two described images to match. names: of them, in the journal. known: `PhotographCameras.given`."""

    ends: tuple[Described, Described]
    names: tuple[str, str]
    seed: int
    known: Mapping[str, Any]


def described_image(pipeline: Pipeline, photograph: Photograph) -> Described:
    """The features of an image file, by one thread."""
    with one_thread(pipeline.device):
        return describe(pipeline, read_image(photograph.image, orient=photograph.orient), photograph.longest_side)


def matched_pair(pipeline: Pipeline, pair: DescribedPair) -> ExportedPair:
    """What a journal keeps of two images, by one thread."""
    with one_thread(pipeline.device):
        result = relate(pipeline, *pair.ends, pair.seed, **pair.known)
    return exported_match(pair.names, pair.ends, result)


@dataclasses.dataclass(eq=False)
class _Begun:
    """A pair under way: its images' features, and what is found of it, once they are there."""

    pair: Pair
    ends: tuple[Future[Described], Future[Described]]
    match: Future[ExportedPair] | None = None

    @property
    def described(self) -> bool:
        return all(end.done() for end in self.ends)

    @property
    def failed(self) -> bool:
        return any(end.done() and end.exception() is not None for end in self.ends)

    @property
    def under_way(self) -> list[Future[Any]]:
        futures: list[Future[Any]] = [*self.ends] if self.match is None else [self.match]
        return [future for future in futures if not future.done()]


def _failed(error: Exception) -> Future[Any]:
    future: Future[Any] = Future()
    future.set_exception(error)
    return future


class FolderMatches:
    """Matches pairs of images into a journal, which this process alone writes; what that has already is taken.

    executor: a `concurrent.futures.Executor` that does the work, not closed at the end; None: threads. workers: its
    size; None: one a core, one for a GPU. build: makes the pipeline in other processes; None: threads share it.
    send_images: as bytes, to workers that do not see the files. cameras: of the images.

    done, taken, related: pairs matched now, taken from the journal, and of either those that show one scene. troubles:
    what went wrong with images or pairs, which are tried again the next time.
    """

    def __init__(
        self, pipeline: Pipeline, journal: Journal, longest_side: int, orient: bool, seed: int, *,
        executor: Executor | None = None, workers: int | None = None, build: Callable[[], Pipeline] | None = None,
        send_images: bool = False, cameras: PhotographCameras | None = None,
    ) -> None:  # fmt: skip
        self.pipeline, self.journal, self.cameras = pipeline, journal, cameras or PhotographCameras()
        self.longest_side, self.orient, self.seed = longest_side, orient, seed
        self.executor, self.send_images = executor, send_images
        self.source: Source[Pipeline] = Here(pipeline) if build is None else Recipe(build)
        usual = min(available(), MAX_WORKERS) if pipeline.device.type == "cpu" else 1
        self.workers = usual if workers is None else workers
        self.done = self.taken = self.related = 0
        self.troubles: list[str] = []
        self._described: OrderedDict[Path, Future[Described]] = OrderedDict()
        self._kept: set[Path] = set()

    def images(self, images: Sequence[Path]) -> Iterator[Described | None]:
        """The features of images, in their order; None of one that cannot be read, which is said once."""
        with self._running() as executor:
            ahead: deque[tuple[Path, Future[Described]]] = deque()
            todo = iter(images)
            while True:
                for image in todo:
                    ahead.append((image, self._image(executor, image)))
                    if len(ahead) > AHEAD * self.workers:
                        break
                if not ahead:
                    return
                yield self._finished(*ahead.popleft())

    def each(self, pairs: Sequence[Pair]) -> Iterator[None]:
        """Match the pairs, and yield after each; they are kept, and troubles told, in an order that is always the same.

        Raises BrokenExecutor where the executor's workers have died.
        """
        todo = iter(in_blocks(pairs, MEMORY // 2))
        begun: deque[_Begun] = deque()
        with self._running() as executor:
            try:
                while True:
                    for pair in todo:
                        if self.journal.has_pair(*pair):
                            self.taken += 1
                            self.related += self.journal.pair(*pair).related
                            yield
                            continue
                        begun.append(_Begun(pair, (self._image(executor, pair[0]), self._image(executor, pair[1]))))
                        if len(begun) >= AHEAD * self.workers:
                            break
                    if not begun:
                        return
                    self._advance(executor, begun)
                    if begun[0].failed or (begun[0].match is not None and begun[0].match.done()):
                        self._keep(begun.popleft())
                        yield
            finally:
                for each in begun:
                    for future in each.under_way:
                        future.cancel()

    @contextlib.contextmanager
    def _running(self) -> Iterator[Executor]:
        if self.executor is not None:
            yield self.executor
            return
        with ThreadPoolExecutor(self.workers) as threads:
            try:
                yield threads
            finally:
                threads.shutdown(wait=True, cancel_futures=True)

    def _advance(self, executor: Executor, begun: deque[_Begun]) -> None:
        """Wait until something has ended, and have pairs matched whose images are described."""
        while True:
            for each in begun:
                if each.match is None and each.described and not each.failed:
                    each.match = self._match(executor, each)
            if begun[0].failed or not begun[0].under_way:
                return
            wait({future for each in begun for future in each.under_way}, return_when=FIRST_COMPLETED)

    def _match(self, executor: Executor, begun: _Begun) -> Future[ExportedPair]:
        names = self.journal.name(begun.pair[0]), self.journal.name(begun.pair[1])
        ends = begun.ends[0].result(), begun.ends[1].result()
        try:
            known = self.cameras.given(begun.pair, [end.size for end in ends])
        except Exception as error:
            return _failed(error)
        pair = DescribedPair(ends, names, self.seed, known)
        return executor.submit(self.source.call(matched_pair, True), pair)

    def _image(self, executor: Executor, image: Path) -> Future[Described]:
        """An image's features, begun unless they are there."""
        if image not in self._described:
            try:
                source = self.cameras.source(image)
                if self.send_images:
                    source = dataclasses.replace(source, data=image.read_bytes())
                photograph = Photograph(source, self.longest_side, self.orient)
                self._described[image] = executor.submit(self.source.call(described_image, True), photograph)
            except (DataError, OSError) as error:  # no camera, or no file
                self._described[image] = _failed(error)
        self._described.move_to_end(image)
        while len(self._described) > MEMORY:
            self._described.popitem(last=False)
        return self._described[image]

    def _finished(self, image: Path, future: Future[Described]) -> Described | None:
        """An image's features, which the journal then has too; None where it cannot be read, which is said once."""
        try:
            described = future.result()
            if image not in self._kept and not self.journal.has_image(image):
                camera = self.cameras.of(image, described.size)
                self.journal.add_image(image, exported_image(self.journal.name(image), described, camera))
        except BrokenExecutor:
            raise
        except Exception as error:  # one image does not end the work on the others
            if image not in self._kept:
                self.troubles.append(f"{type(error).__name__}: {error}".splitlines()[0])
            described = None
        self._kept.add(image)
        return described

    def _keep(self, begun: _Begun) -> None:
        ends = [self._finished(image, end) for image, end in zip(begun.pair, begun.ends, strict=True)]
        if begun.match is None or None in ends:
            return
        try:
            pair = begun.match.result()
            self.journal.add_pair(*begun.pair, pair)
        except BrokenExecutor:
            raise
        except Exception as error:  # nor does one pair
            names = f"{self.journal.name(begun.pair[0])}, {self.journal.name(begun.pair[1])}"
            self.troubles.append(f"{names}: {type(error).__name__}: {error}".splitlines()[0])
            return
        self.done += 1
        self.related += pair.related
