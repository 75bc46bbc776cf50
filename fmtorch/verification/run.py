"""Pairs of stored matches, estimated batch by batch; their geometries are kept until all are there."""

import dataclasses
import shutil
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core.files import replacing
from fmtorch.core.settings import claim
from fmtorch.core.stages import Estimator
from fmtorch.core.types import CONTRADICTED, Correspondences, collate, pair_key
from fmtorch.io.colmap import DatabaseImage
from fmtorch.io.match_store import MATRICES, Kind, PairGeometry
from fmtorch.jobs.execution import Execution, Shard
from fmtorch.jobs.runner import Factory, Local, Source, TaskRunner, WorkerPool
from fmtorch.pipeline.pair_geometries import pair_geometries
from fmtorch.two_view.arguments import correspondences
from fmtorch.two_view.estimation import estimated_by
from fmtorch.two_view.pair_type import classify

Cameras = Literal["stored", "shared", "unknown"]
"""What is taken for known: the cameras of the database, that both images have one focal length, or nothing."""


class DatabasePair(NamedTuple):
    """A pair of images with its matches, keypoints (n, 2) of both."""

    image0: DatabaseImage
    image1: DatabaseImage
    matches: NDArray[np.int64]


def as_correspondences(pair: DatabasePair, cameras: Cameras) -> Correspondences:
    """The pair as a batch of one, with what is known of its cameras; of pinholes where these are those stored.
    Without image sizes and K nothing is asked of cameras. Raises ValueError where a stored camera is none that there
    can be, and as `fmtorch.find_fundamental` for values, sizes and points that contradict each other."""
    images, stored = (pair.image0, pair.image1), cameras == "stored"
    if stored and (problem := images[0].problem or images[1].problem):
        raise ValueError(problem)
    known: dict[str, Any] = {f"size{i}": image.size for i, image in enumerate(images)}
    known |= {f"K{i}": image.K for i, image in enumerate(images)} if stored else {}
    sized, with_K = any(image.size is not None for image in images), stored and any(i.K is not None for i in images)
    if cameras == "shared" and not sized:
        raise ValueError("cameras=shared needs the image sizes: size0 and size1")
    focal: Any = [image.deviation for image in images] if with_K else "unknown" if sized else None
    key = pair_key(f"{images[0].name} {images[1].name}")
    points = [image.points[pair.matches[:, i]] for i, image in enumerate(images)]
    mask: Any = np.isfinite(points[0]).all(-1) & np.isfinite(points[1]).all(-1)
    c = correspondences(*points, mask=mask, focal=focal, key=key, **known)
    if sized or with_K:
        same = (
            stored and images[0].camera_id == images[1].camera_id and images[0].deviation > 0
        )  # and not exactly known
        c = c.derived(shared_focal=torch.tensor([cameras == "shared" or same]))
    if not stored or all(image.pinhole is image.points for image in images):
        return c
    x0, x1 = (torch.from_numpy(image.pinhole[pair.matches[:, i]])[None] for i, image in enumerate(images))
    return c.derived(x0=x0, x1=x1, mask=torch.isfinite(x0).all(-1) & torch.isfinite(x1).all(-1))


SETTINGS = "settings.json"
_PairIds = tuple[Any, Any]


class GeometryParts:
    """The folder, which any number of processes and shards of the same settings may write to.
    done: the pairs that it has. Raises ValueError where it holds geometries of other settings."""

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder = folder
        claim(folder / SETTINGS, settings, "geometries", f"give the same, or delete {folder}")
        self.done: set[_PairIds] = set()
        for path in self._files():
            with np.load(path) as part:
                self.done.update((first, second) for first, second in part["pairs"].tolist())

    def write(self, geometries: Iterable[tuple[_PairIds, PairGeometry]]) -> None:
        arrays: dict[str, Any] = {}
        pairs, kinds, texts = [], [], []
        for i, (ids, geometry) in enumerate(geometries):
            pairs.append(ids)
            kinds.append(geometry.kind)
            texts.append((geometry.reason, geometry.warning))
            values = {"inliers": geometry.inliers, **geometry.matrices}
            arrays |= {f"{name}-{i}": value for name, value in values.items()}
        with replacing(self.folder / f"{uuid.uuid4().hex}.npz") as temporary, temporary.open("wb") as file:
            np.savez(file, pairs=np.array(pairs), kinds=np.array(kinds), texts=np.array(texts), **arrays)
        self.done.update(pairs)

    def read(self) -> Iterator[tuple[_PairIds, PairGeometry]]:
        seen: set[_PairIds] = set()
        for path in self._files():
            with np.load(path) as part:
                for i, ((first, second), kind) in enumerate(zip(part["pairs"].tolist(), part["kinds"], strict=True)):
                    if (first, second) not in seen:
                        seen.add((first, second))
                        yield (first, second), _geometry(part, i, str(kind))

    def remove(self) -> None:
        shutil.rmtree(self.folder)

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("*.npz"))


def _geometry(part: Any, i: int, kind: str) -> PairGeometry:
    matrices = (part.get(f"{name}-{i}") for name in MATRICES)
    return PairGeometry(cast(Kind, kind), part[f"inliers-{i}"], *matrices, *part["texts"][i].tolist())


BATCH = 64  # pairs that are read, and kept, at a time
PRELOADED = (__name__,)  # by the process that workers are forked of


@runtime_checkable
class PairStore(Protocol):
    """Matches of pairs of images, and a place for their geometries; see `MatchDatabase`.
    identity: by what the matches are known again, as plain values. pairs: those that have matches. matches: of a pair,
    keypoints (n, 2) of its images. has_geometry: of a failure too. write: the geometries of all pairs, or none."""

    def identity(self) -> dict[str, Any]: ...
    def pairs(self) -> list[_PairIds]: ...
    def image(self, image_id: Any) -> DatabaseImage: ...
    def matches(self, pair: _PairIds) -> NDArray[np.int64]: ...
    def has_geometry(self, pair: _PairIds) -> bool: ...
    def write(self, geometries: Iterable[tuple[_PairIds, PairGeometry]]) -> None: ...
    def name(self, image_id: Any) -> str: ...


@dataclasses.dataclass(frozen=True)
class Verification:
    """What `verify` did with a database.

    path: of the database with the geometries; of a shard, the folder that keeps them. pairs: that have matches. kept:
    of these, that had a geometry before, or were finished by an interrupted run or a shard. configurations: how many
    of each of COLMAP's kinds were written. problems: why pairs could not be read, a line each; the next run tries them
    again. warnings: what of a camera was not believed, a line each. seconds: of the whole.
    """

    path: Path
    pairs: int
    kept: int
    configurations: Mapping[str, int]
    problems: tuple[str, ...]
    seconds: float
    warnings: tuple[str, ...] = ()

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

    ids: list[_PairIds]
    pairs: list[DatabasePair]
    problems: list[tuple[_PairIds, str]]


Geometries = tuple[list[tuple[_PairIds, PairGeometry]], list[tuple[_PairIds, str]]]  # and the problems of the others


def estimate_batch(how: Estimation, batch: Batch) -> Geometries:
    """What a worker does."""
    ids, pairs, given, problems = [], [], [], list[tuple[_PairIds, str]]()
    for own, pair in zip(batch.ids, batch.pairs, strict=True):
        try:
            given.append(as_correspondences(pair, how.cameras))
            ids.append(own)
            pairs.append(pair)
        except Exception as error:  # one pair does not end the work on the others
            problems.append((own, _first_line(error)))
    results: dict[int, PairGeometry] = {}
    for alike in _alike(given):
        c = collate([given[i] for i in alike])
        estimate = estimated_by(how.estimator, c, how.seed)
        configuration = classify(c, estimate, focal_deviation=0, seed=how.seed)
        of_these = pair_geometries([pairs[i].matches for i in alike], c, estimate, configuration)
        results |= zip(alike, of_these, strict=True)
    return [(own, results[i]) for i, own in enumerate(ids)], problems


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
    kept into the store. force: estimate pairs that have a geometry in the store, too."""

    def __init__(self, store: PairStore, parts: GeometryParts, shard: Shard | None = None, force: bool = False) -> None:
        self.store, self.parts = store, parts
        pairs = store.pairs()
        self.pairs = pairs if shard is None else list(shard.of(pairs))
        self.todo = [p for p in self.pairs if p not in parts.done and (force or not store.has_geometry(p))]
        self.configurations: Counter[str] = Counter()
        self.problems: list[str] = []
        self.warnings: dict[str, None] = {}  # in order

    def each_batch(
        self, make: Callable[[], Estimation], execution: Execution, report: Callable[[int, int], None] | None
    ) -> None:
        """Estimate and keep the pairs that are not done, batch by batch; `make` is pickled for workers elsewhere."""
        todo = self.todo
        if report is not None and todo:
            report(0, len(todo))

        def given_up(batch: Batch, reason: str) -> None:
            self._keep(batch, ([], [(ids, reason) for ids in batch.ids]))

        source: Source[Estimation] = Local(make()) if execution.shared else Factory(make)
        batches = (self._read(todo[start : start + BATCH]) for start in range(0, len(todo), BATCH))
        done = 0
        with WorkerPool(execution, PRELOADED) as pool:
            runner = TaskRunner(pool, source, estimate_batch, self._keep, given_up, divided)
            for batch in runner.each(batches):
                done += len(batch.ids) + len(batch.problems)
                if report is not None:
                    report(done, len(todo))

    def write(self) -> None:
        self.configurations.clear()
        self.store.write(self._counted(self.parts.read()))

    def result(self, path: Path, seconds: float) -> Verification:
        """The summary."""
        kept, counts = len(self.pairs) - len(self.todo), dict(self.configurations)
        return Verification(path, len(self.pairs), kept, counts, tuple(self.problems), seconds, tuple(self.warnings))

    def _counted(self, geometries: Iterable[tuple[_PairIds, PairGeometry]]) -> Iterator[tuple[_PairIds, PairGeometry]]:
        for ids, geometry in geometries:
            self.configurations[geometry.kind] += 1
            if CONTRADICTED in geometry.warning:
                self.warnings[f"{self._names(ids)}: {CONTRADICTED}"] = None
            yield ids, geometry

    def _read(self, pairs: Sequence[_PairIds]) -> Batch:
        batch = Batch([], [], [])
        for pair in pairs:
            try:
                matches = self.store.matches(pair)
                images = [self.store.image(image) for image in pair]
                self.warnings.update((image.warning, None) for image in images if image.warning)
                batch.pairs.append(DatabasePair(images[0], images[1], matches))
                batch.ids.append(pair)
            except Exception as error:  # one pair does not end the work on the others
                batch.problems.append((pair, _first_line(error)))
        return batch

    def _keep(self, batch: Batch, result: Geometries) -> None:
        geometries, problems = result
        self.problems += [f"{self._names(pair)}: {problem}" for pair, problem in (*batch.problems, *problems)]
        if geometries:
            self.parts.write(self._counted(geometries))

    def _names(self, pair: _PairIds) -> str:
        return ", ".join(self.store.name(image) for image in pair)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0]
