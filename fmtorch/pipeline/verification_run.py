"""Pairs of stored matches, estimated batch by batch; their geometries are kept until all are there."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fmtorch.core.stages import Estimator
from fmtorch.core.types import Correspondences, collate
from fmtorch.jobs.execution import Execution, Shard
from fmtorch.jobs.pool import WorkerPool
from fmtorch.jobs.runner import Factory, Local, Source, TaskRunner
from fmtorch.pipeline.database_pairs import Cameras, DatabasePair, as_correspondences
from fmtorch.pipeline.pair_geometries import pair_geometries
from fmtorch.storage.exchange.database_images import DatabaseImage
from fmtorch.storage.exchange.geometry_parts import GeometryParts
from fmtorch.storage.exchange.two_view import PairGeometry
from fmtorch.two_view.estimation import estimated_by
from fmtorch.two_view.pair_type import classify

BATCH = 64  # pairs that are read, and kept, at a time
PRELOADED = ("fmtorch.pipeline.verification_run",)  # by the process that workers are forked of

Ids = tuple[Any, Any]


@runtime_checkable
class MatchStore(Protocol):
    """Matches of pairs of images, and a place for their geometries; see `MatchDatabase`."""

    def identity(self) -> dict[str, Any]:
        """By what the matches are known again, as plain values."""

    def pairs(self) -> list[Ids]:
        """The pairs of images that have matches."""

    def image(self, image_id: Any) -> DatabaseImage:
        """An image with its keypoints."""

    def matches(self, pair: Ids) -> NDArray[np.int64]:
        """The matches of a pair, keypoints (n, 2) of its images."""

    def has_geometry(self, pair: Ids) -> bool:
        """Whether a pair has a geometry, of a failure too."""

    def write(self, geometries: Iterable[tuple[Ids, PairGeometry]]) -> None:
        """Write the geometries of all pairs, all of them or none."""

    def name(self, image_id: Any) -> str:
        """The name of an image."""


@dataclasses.dataclass(frozen=True)
class Verification:
    """What `verify` did with a database.

    path: of the database with the geometries; of a shard, the folder that keeps them. pairs: that have matches. kept:
    of these, that had a geometry before, or were finished by an interrupted run or a shard. configurations: how many
    of each of COLMAP's kinds were written. problems: why pairs could not be read, a line each; the next run tries them
    again. seconds: of the whole.
    """

    path: Path
    pairs: int
    kept: int
    configurations: Mapping[str, int]
    problems: tuple[str, ...]
    seconds: float

    @property
    def verified(self) -> int:
        """How many pairs were given a geometry: all but the degenerate ones."""
        return sum(count for kind, count in self.configurations.items() if kind != "degenerate")


class Estimation(NamedTuple):
    """What estimates batches of pairs."""

    estimator: Estimator
    cameras: Cameras
    seed: int


class Batch(NamedTuple):
    """Pairs that were read; the problems of those that could not be, or not be estimated."""

    ids: list[Ids]
    pairs: list[DatabasePair]
    problems: list[tuple[Ids, str]]


class Geometries(NamedTuple):
    """The geometries of a batch's pairs; the problems of the others."""

    ids: list[Ids]
    geometries: list[PairGeometry]
    problems: list[tuple[Ids, str]]


def estimate_batch(how: Estimation, batch: Batch) -> Geometries:
    """What a worker does."""
    ids, pairs, given, problems = [], [], [], list[tuple[Ids, str]]()
    for own, pair in zip(batch.ids, batch.pairs, strict=True):
        try:
            given.append(as_correspondences(pair, how.cameras))
            ids.append(own)
            pairs.append(pair)
        except Exception as error:  # one pair does not end the work on the others
            problems.append((own, _first_line(error)))
    if not ids:
        return Geometries([], [], problems)
    results: dict[int, PairGeometry] = {}
    for alike in _alike(given):
        c = collate([given[i] for i in alike])
        estimate = estimated_by(how.estimator, c, how.seed)
        configuration = classify(c, estimate, focal_deviation=0, seed=how.seed)
        of_these = pair_geometries([pairs[i].matches for i in alike], c, estimate, configuration)
        results |= zip(alike, of_these, strict=True)
    return Geometries(ids, [results[i] for i in range(len(ids))], problems)


def _alike(given: Sequence[Correspondences]) -> list[list[int]]:
    """Indices of pairs of which the same is known: in one batch a pair would lose what another lacks."""
    groups: dict[tuple[bool, ...], list[int]] = {}
    for i, c in enumerate(given):
        known = tuple(getattr(c, field.name) is not None for field in dataclasses.fields(c))
        groups.setdefault(known, []).append(i)
    return list(groups.values())


def divided(batch: Batch) -> list[Batch]:
    """The pairs of a batch in batches of their own."""
    return [Batch([ids], [pair], []) for ids, pair in zip(batch.ids, batch.pairs, strict=True)]


class VerificationRun:
    """The pairs of one store of matches.

    parts: keeps their geometries. shard: only these pairs, which are kept there; None: all, and `write` moves what is
    kept into the store. force: estimate pairs that have a geometry in the store, too.
    """

    def __init__(
        self, store: MatchStore, parts: GeometryParts, shard: Shard | None = None, force: bool = False
    ) -> None:
        self.store, self.parts = store, parts
        pairs = store.pairs()
        self.pairs = pairs if shard is None else list(shard.of(pairs))
        self.todo = [p for p in self.pairs if p not in parts.done and (force or not store.has_geometry(p))]
        self.configurations: Counter[str] = Counter()
        self.problems: list[str] = []

    def each_batch(
        self, make: Callable[[], Estimation], execution: Execution, report: Callable[[int, int], None] | None
    ) -> None:
        """Estimate and keep the pairs that are not done, batch by batch; `make` is pickled for workers elsewhere."""
        todo = self.todo
        if report is not None and todo:
            report(0, len(todo))
        source: Source[Estimation] = Local(make()) if execution.shared else Factory(make)
        batches = (self._read(todo[start : start + BATCH]) for start in range(0, len(todo), BATCH))
        done = 0
        with WorkerPool(execution, PRELOADED) as pool:
            for batch in TaskRunner(pool, source, estimate_batch, self._keep, self._give_up, divided).each(batches):
                done += len(batch.ids) + len(batch.problems)
                if report is not None:
                    report(done, len(todo))

    def write(self) -> None:
        """Write what is kept into the store."""
        self.configurations.clear()
        self.store.write(self._counted(self.parts.read()))

    def result(self, path: Path, seconds: float) -> Verification:
        """The summary."""
        kept, counts = len(self.pairs) - len(self.todo), dict(self.configurations)
        return Verification(path, len(self.pairs), kept, counts, tuple(self.problems), seconds)

    def _counted(self, geometries: Iterable[tuple[Ids, PairGeometry]]) -> Iterator[tuple[Ids, PairGeometry]]:
        for ids, geometry in geometries:
            self.configurations[geometry.kind] += 1
            yield ids, geometry

    def _read(self, pairs: Sequence[Ids]) -> Batch:
        batch = Batch([], [], [])
        for pair in pairs:
            try:
                matches = self.store.matches(pair)
                batch.pairs.append(DatabasePair(self.store.image(pair[0]), self.store.image(pair[1]), matches))
                batch.ids.append(pair)
            except Exception as error:  # one pair does not end the work on the others
                batch.problems.append((pair, _first_line(error)))
        return batch

    def _keep(self, batch: Batch, result: Geometries) -> None:
        self._note([*batch.problems, *result.problems])
        if result.ids:
            self.parts.write(self._counted(zip(result.ids, result.geometries, strict=True)))

    def _give_up(self, batch: Batch, reason: str) -> None:
        self._note([*batch.problems, *((ids, reason) for ids in batch.ids)])

    def _note(self, problems: Iterable[tuple[Ids, str]]) -> None:
        for pair, problem in problems:
            self.problems.append(f"{', '.join(self.store.name(image) for image in pair)}: {problem}")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0]
