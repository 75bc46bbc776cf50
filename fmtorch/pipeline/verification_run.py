"""Pairs of stored matches, estimated and written batch by batch."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fmtorch.core.stages import Estimator
from fmtorch.core.types import Correspondences, collate
from fmtorch.pipeline.configuration import classify
from fmtorch.pipeline.database_pairs import Cameras, DatabasePair, as_correspondences
from fmtorch.pipeline.estimation import estimated_by
from fmtorch.pipeline.pair_geometries import pair_geometries
from fmtorch.storage.exchange.database_images import DatabaseImage
from fmtorch.storage.exchange.two_view import PairGeometry
from fmtorch.storage.exchange.verification_log import VerificationLog

BATCH = 64  # pairs in memory

Ids = tuple[Any, Any]


@runtime_checkable
class MatchStore(Protocol):
    """Matches of pairs of images, and a place for their geometries; see `MatchDatabase`."""

    def pairs(self) -> list[Ids]:
        """The pairs of images that have matches."""

    def image(self, image_id: Any) -> DatabaseImage:
        """An image with its keypoints."""

    def matches(self, pair: Ids) -> NDArray[np.int64]:
        """The matches of a pair, keypoints (n, 2) of its images."""

    def has_geometry(self, pair: Ids) -> bool:
        """Whether a pair has a geometry, of a failure too."""

    def write(self, geometries: Iterable[tuple[Ids, PairGeometry]]) -> None:
        """Write geometries, all of them or none."""

    def name(self, image_id: Any) -> str:
        """The name of an image."""


@dataclasses.dataclass(frozen=True)
class Verification:
    """What `verify` did with a database.

    path: of the database with the geometries. pairs: that have matches. kept: of these, that had a geometry before or
    were finished by an interrupted run. configurations: of the others, how many of each of COLMAP's kinds. problems:
    why pairs could not be read, a line each; the next run tries them again. seconds: of the whole.
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


class VerificationRun:
    """The pairs of one store of matches. log: of the pairs that count as done, else those with a geometry."""

    def __init__(
        self, database: MatchStore, cameras: Cameras, seed: int, estimator: Estimator,
        log: VerificationLog | None = None,
    ) -> None:  # fmt: skip
        self.database, self.cameras, self.seed, self.estimator, self.log = database, cameras, seed, estimator, log
        self.pairs = database.pairs()
        self.configurations: Counter[str] = Counter()
        self.problems: list[str] = []
        self.kept = 0

    def each_batch(self, report: Callable[[int, int], None] | None) -> None:
        """Estimate and write the pairs that are not done, batch by batch."""
        todo = [pair for pair in self.pairs if not self._done(pair)]
        self.kept = len(self.pairs) - len(todo)
        if report is not None and todo:
            report(0, len(todo))
        for start in range(0, len(todo), BATCH):
            batch = todo[start : start + BATCH]
            self._verify(batch)
            if report is not None:
                report(start + len(batch), len(todo))

    def result(self, path: Path, seconds: float) -> Verification:
        """The summary."""
        counts = dict(self.configurations)
        return Verification(path, len(self.pairs), self.kept, counts, tuple(self.problems), seconds)

    def _done(self, pair: Ids) -> bool:
        return self.database.has_geometry(pair) if self.log is None else pair in self.log.done

    def _verify(self, batch: Sequence[Ids]) -> None:
        """Estimate a batch of pairs and write what is found."""
        ids, pairs, given = [], [], []
        for pair in batch:
            try:
                matches = self.database.matches(pair)
                pairs.append(DatabasePair(self.database.image(pair[0]), self.database.image(pair[1]), matches))
                given.append(as_correspondences(pairs[-1], self.cameras))
                ids.append(pair)
            except Exception as error:  # one pair does not end the work on the others
                del pairs[len(ids) :]
                names = ", ".join(self.database.name(image) for image in pair)
                self.problems.append(f"{names}: {error}".splitlines()[0])
        if not ids:
            return
        results: list[PairGeometry | None] = [None] * len(ids)
        for alike in _alike(given):
            c = collate([given[i] for i in alike])
            estimate = estimated_by(self.estimator, c, self.seed)
            configuration = classify(c, estimate, focal_deviation=0, seed=self.seed)
            found = pair_geometries([pairs[i].matches for i in alike], c, estimate, configuration)
            for i, geometry in zip(alike, found, strict=True):
                results[i] = geometry
        written = [(pair, result) for pair, result in zip(ids, results, strict=True) if result is not None]
        self.database.write(written)
        if self.log is not None:
            self.log.add(ids)
        self.configurations.update(result.kind for _, result in written)


def _alike(given: Sequence[Correspondences]) -> list[list[int]]:
    """Indices of pairs of which the same is known: in one batch a pair would lose what another lacks."""
    groups: dict[tuple[bool, ...], list[int]] = {}
    for i, c in enumerate(given):
        known = tuple(getattr(c, field.name) is not None for field in dataclasses.fields(c))
        groups.setdefault(known, []).append(i)
    return list(groups.values())
