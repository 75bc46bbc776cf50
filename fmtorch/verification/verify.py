"""Two-view geometries of a COLMAP database, of hloc's files, or of matches alone, whoever made them.

Pairs are estimated batch by batch; their geometries are kept until all are there."""

import contextlib
import dataclasses
import functools
import shutil
import sqlite3
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, cast, get_args, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch import presets
from fmtorch.core import checks, claim, replacing, stages, terminal
from fmtorch.core.failures import own_traceback
from fmtorch.core.types import CONTRADICTED, Correspondences, collate, pair_key
from fmtorch.core.version import __version__
from fmtorch.io import colmap
from fmtorch.io.match_file import SUFFIXES, HlocMatches, MatchFile, expect_suffix
from fmtorch.io.match_store import MATRICES, Kind, PairGeometry
from fmtorch.jobs.execution import Execution, Shard, shard_of
from fmtorch.jobs.runner import Factory, Local, Source, TaskRunner, WorkerPool
from fmtorch.pipeline.photographs import pair_geometries
from fmtorch.two_view import arguments, pair_type
from fmtorch.two_view.estimation import estimated_by
from fmtorch.two_view.lenses import with_stretch

Cameras = Literal["stored", "shared", "unknown"]  # what is known: those stored, one focal length, nothing
_PairIds = tuple[Any, Any]


class DatabasePair(NamedTuple):
    """A pair of images with its matches, keypoints (n, 2) of both."""

    image0: colmap.DatabaseImage
    image1: colmap.DatabaseImage
    matches: NDArray[np.int64]


def as_correspondences(pair: DatabasePair, cameras: Cameras, lens: arguments.Lens = None) -> Correspondences:
    """The pair as a batch of one, with what is known of its cameras; of pinholes where these are those stored.
    lens: as of `fmtorch.find_fundamental`, where no stored lens distorts.
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
    straight = not stored or all(image.pinhole is image.points for image in images)
    if lens is not None and not all(image.size is not None for image in images):
        raise ValueError("lens needs the image sizes: size0 and size1")
    c = arguments.correspondences(*points, mask=mask, focal=focal, lens=lens if straight else None, key=key, **known)
    if sized or with_K:
        same = images[0].camera_id == images[1].camera_id and images[0].deviation > 0
        c = c.derived(shared_focal=torch.tensor([cameras == "shared" or (stored and same)]))
    if straight:
        return c
    x = np.stack([image.pinhole[pair.matches[:, i]] for i, image in enumerate(images)], 1)
    J = np.broadcast_to(np.eye(2), (*x.shape, 2)).copy()
    for i, image in enumerate(images):
        if image.stretch is not None:
            J[:, i] = image.stretch[pair.matches[:, i]]
    seen: Any = np.isfinite(x).all((1, 2)) & np.isfinite(J).all((1, 2, 3))
    J[~seen] = 0
    x0, x1 = (torch.from_numpy(x[None, :, i]) for i in (0, 1))
    return with_stretch(c.derived(x0=x0, x1=x1, mask=torch.ones_like(c.mask)), J[None], seen[None])


class GeometryParts:
    """The folder, which any number of processes and shards of the same settings may write to.
    done: the pairs that it has. Raises ValueError where it holds geometries of other settings."""

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder = folder
        claim(folder / "settings.json", settings, "geometries", f"give the same, or delete {folder}")
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
                        matrices = (part.get(f"{name}-{i}") for name in MATRICES)
                        known = part[f"inliers-{i}"], *matrices, *part["texts"][i].tolist()
                        yield (first, second), PairGeometry(cast(Kind, str(kind)), *known)

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("*.npz"))


BATCH = 64  # pairs that are read, and kept, at a time
ONE_THREAD = Execution("threads", 1)  # that calls an estimator, which uses as many as torch may
PRELOADED = (__name__,)  # by the process that workers are forked of


@runtime_checkable
class PairStore(Protocol):
    """Matches of pairs of images, and a place for their geometries; see `MatchDatabase`.
    identity: by what the matches are known again, as plain values. pairs: those that have matches. matches: of a pair,
    keypoints (n, 2) of its images. has_geometry: of a failure too. write: the geometries of all pairs, or none."""

    def identity(self) -> dict[str, Any]: ...
    def pairs(self) -> list[_PairIds]: ...
    def image(self, image_id: Any) -> colmap.DatabaseImage: ...
    def matches(self, pair: _PairIds) -> NDArray[np.int64]: ...
    def has_geometry(self, pair: _PairIds) -> bool: ...
    def write(self, geometries: Iterable[tuple[_PairIds, PairGeometry]]) -> None: ...
    def name(self, image_id: Any) -> str: ...


@dataclasses.dataclass(frozen=True)
class Verification:
    """What `verify` did with a database.
    path: of the database with the geometries; of a shard, the folder that keeps them. pairs: that have matches. kept:
    of these, that had a geometry before, or were finished by an interrupted run or a shard. configurations: how many of
    each of COLMAP's kinds were written. problems: why pairs could not be read, a line each; the next run tries them
    again. seconds: of the whole. warnings: what of a camera was not believed, a line each. tracebacks: of own parts."""

    path: Path
    pairs: int
    kept: int
    configurations: Mapping[str, int]
    problems: tuple[str, ...]
    seconds: float
    warnings: tuple[str, ...] = ()
    tracebacks: tuple[str, ...] = ()

    @property
    def verified(self) -> int:
        """How many pairs were given a geometry: all but the degenerate ones."""
        return sum(count for kind, count in self.configurations.items() if kind != "degenerate")


@dataclasses.dataclass(frozen=True)
class VerifyMode:
    """How pairs are verified, and which, as `verify` takes it; debug: whether an estimator's error ends the run."""

    cameras: str = "stored"
    lens: arguments.Lens = None
    force: bool = False
    seed: int = 0
    execution: Execution = ONE_THREAD
    shard: Shard | None = None
    debug: bool = False


class Batch(NamedTuple):
    """Pairs that were read, and how to estimate them; the problems of those that could not be read."""

    mode: VerifyMode
    ids: list[_PairIds]
    pairs: list[DatabasePair]
    problems: list[tuple[_PairIds, str]]


Geometries = tuple[list[tuple[_PairIds, PairGeometry]], list[tuple[_PairIds, str]]]  # and the problems of the others


def estimate_batch(estimator: stages.Estimator, batch: Batch) -> Geometries:
    """What a worker does."""
    given, problems = dict[int, Correspondences](), list[tuple[_PairIds, str]]()
    for i, pair in enumerate(batch.pairs):
        try:
            given[i] = as_correspondences(pair, cast(Cameras, batch.mode.cameras), batch.mode.lens)
        except Exception as error:  # one pair does not end the work on the others
            problems.append((batch.ids[i], terminal.error_line(error)))
    results, groups = dict[int, PairGeometry](), _alike(given)
    while groups:
        alike = groups.pop(0)
        c = collate([given[i] for i in alike])
        try:
            estimate = estimated_by(estimator, c, batch.mode.seed)
        except Exception as error:  # of an estimator of the user's own
            if batch.mode.debug:
                raise
            if len(alike) > 1:
                groups += [[i] for i in alike]
            else:
                problems.append((batch.ids[alike[0]], f"{terminal.error_line(error)}\n{own_traceback(error)}"))
            continue
        configuration = pair_type.classify(c, estimate, focal_deviation=0, seed=batch.mode.seed)
        of_these = pair_geometries([batch.pairs[i].matches for i in alike], c, estimate, configuration)
        results |= zip(alike, of_these, strict=True)
    return [(own, results[i]) for i, own in enumerate(batch.ids) if i in results], problems


def _alike(given: Mapping[int, Correspondences]) -> list[list[int]]:
    """Numbers of pairs of which the same is known: in one batch a pair would lose what another lacks."""
    groups: dict[tuple[bool, ...], list[int]] = {}
    for i, c in given.items():
        known = tuple(getattr(c, field.name) is not None for field in dataclasses.fields(c))
        groups.setdefault(known, []).append(i)
    return list(groups.values())


def divided(batch: Batch) -> list[Batch]:
    """The pairs of a batch in batches of their own."""
    each = zip(batch.ids, batch.pairs, strict=True)
    return [batch._replace(ids=[ids], pairs=[pair], problems=[]) for ids, pair in each]


class VerificationRun:
    """The pairs of one store of matches.
    parts: keeps their geometries, of a shard of the pairs for good; of all pairs `write` moves them into the store."""

    def __init__(self, store: PairStore, parts: GeometryParts, mode: VerifyMode) -> None:
        self.store, self.parts, self.mode = store, parts, mode
        pairs = store.pairs()
        self.pairs = pairs if mode.shard is None else list(mode.shard.of(pairs))
        self.todo = [p for p in self.pairs if p not in parts.done and (mode.force or not store.has_geometry(p))]
        self.configurations: Counter[str] = Counter()
        self.problems: list[str] = []
        self.warnings: dict[str, None] = {}  # in order
        self.tracebacks: dict[str, None] = {}

    def each_batch(self, source: Source[stages.Estimator], report: Callable[[int, int], None]) -> None:
        todo, done = self.todo, 0
        if todo:
            report(0, len(todo))

        def given_up(batch: Batch, reason: str) -> None:
            self._keep(batch, ([], [(ids, reason) for ids in batch.ids]))

        batches = (self._read(todo[start : start + BATCH]) for start in range(0, len(todo), BATCH))
        with WorkerPool(self.mode.execution, PRELOADED) as pool:
            runner = TaskRunner(pool, source, estimate_batch, self._keep, given_up, divided)
            for batch in runner.each(batches):
                done += len(batch.ids) + len(batch.problems)
                report(done, len(todo))

    def write(self) -> None:
        self.configurations.clear()
        self.store.write(self._counted(self.parts.read()))

    def result(self, path: Path, seconds: float) -> Verification:
        kept, counts = len(self.pairs) - len(self.todo), dict(self.configurations)
        texts = tuple(self.warnings), tuple(self.tracebacks)
        return Verification(path, len(self.pairs), kept, counts, tuple(self.problems), seconds, *texts)

    def _counted(self, geometries: Iterable[tuple[_PairIds, PairGeometry]]) -> Iterator[tuple[_PairIds, PairGeometry]]:
        for ids, geometry in geometries:
            self.configurations[geometry.kind] += 1
            if CONTRADICTED in geometry.warning:
                self.warnings[f"{self._names(ids)}: {CONTRADICTED}"] = None
            yield ids, geometry

    def _read(self, pairs: Sequence[_PairIds]) -> Batch:
        batch = Batch(self.mode, [], [], [])
        for pair in pairs:
            try:
                matches = self.store.matches(pair)
                images = [self.store.image(image) for image in pair]
                self.warnings.update((image.warning, None) for image in images if image.warning)
                batch.pairs.append(DatabasePair(images[0], images[1], matches))
                batch.ids.append(pair)
            except Exception as error:  # one pair does not end the work on the others
                batch.problems.append((pair, terminal.error_line(error)))
        return batch

    def _keep(self, batch: Batch, result: Geometries) -> None:
        geometries, problems = result
        for pair, problem in (*batch.problems, *problems):
            line, _, trace = problem.partition("\n")
            self.problems.append(f"{self._names(pair)}: {line}")
            self.tracebacks |= {trace: None} if trace else {}
        if geometries:
            self.parts.write(self._counted(geometries))

    def _names(self, pair: _PairIds) -> str:
        return ", ".join(self.store.name(image) for image in pair)


HLOC_NEEDS = "hloc's files need features=F.h5 matches=M.h5 output=VERIFIED.h5, and no database"
MATCHES_NEED = "matches alone need an output: matches=FILE.npz output=VERIFIED.npz, with features=F.h5 of hloc's files"


def verify(
    path: Path | str | None = None, *, features: Path | str | None = None, matches: Path | str | None = None,
    output: Path | str | None = None, cameras: str = "stored", lens: arguments.Lens = None, estimator: str = "fmtorch",
    force: bool = False, seed: int = 0, config_dir: Path | str | None = None,
    report: Callable[[int, int], None] | None = None, execution: Execution | None = None, shard: str | None = None,
    **options: Any,
) -> Verification:  # fmt: skip
    """Estimate the two-view geometry of every pair with matches in a COLMAP database, as its mappers read it.

    Configuration, inlier matches, F, E, H and relative pose are written, in one transaction. Until all pairs are done a
    folder beside the database keeps them: a run that is killed leaves the database as it was, and the same call
    continues it. Keypoints, matches, cameras, rigs and frames stay as they are.

    Args:
        path: the database, of COLMAP 3 or 4, with keypoints of 2, 4 or 6 columns and cameras of any model with a lens.
        features, matches: hloc's two files in place of a database. They know no cameras; "stored" is "unknown" then.
            matches alone: an npz or HDF5 file of x0, x1 (n, 2), pixels, and perhaps K0, K1 (3, 3), size0, size1 (h, w),
            of one pair or of each pair below its name (``a/x0``). Without K and sizes a pair has F and H, but no pose.
        output: a new database to write to instead; it gets this name once it is complete; one that has all pairs is
            left as it is. For hloc's files, a new file of the matches that are inliers, with the matrices as
            attributes. For matches alone, an npz or HDF5 file of each pair's `configuration`, `inliers` (n,), and F, E,
            H, R, t, `reason` and `warning` as far as it has them.
        cameras: "stored": points are undistorted, focal lengths are exact where the camera was calibrated, known within
            5 % where they have a prior and nothing else is known of the camera (EXIF), and unknown where they are
            COLMAP's guess; images of one camera share theirs. "shared": all images have one unknown focal length in
            units of the longer side, without distortion. "unknown": nothing is known.
        lens: as of `find_fundamental`: how much photographs bend straight lines, where the stored cameras do not. The
            matrices then relate undistorted points; the inliers are those of the photographs.
        estimator: a preset of conf/estimator.
        force: estimate pairs that have a geometry as well, and replace an existing `output`.
        seed: of the random numbers.
        config_dir: a folder with presets of your own, as of `find_fundamental`.
        report: called with the numbers of pairs done and of all pairs, at the start and after each batch.
        execution: by which workers, ``fmtorch.jobs.Execution("processes", 4)`` say; None: threads of the estimator.
        shard: "2/8" for the second eighth of the pairs. A call without it estimates what is missing and writes all.
        options: replace values of the preset (``inlier_threshold=1.0``).

    Raises:
        FileNotFoundError: where there is no database.
        ValueError: for another file, a database of a newer COLMAP, without keypoints or without matches; for an
            `output` that exists and lacks pairs, an unknown preset, option or kind of cameras.
        ImportError: without pycolmap.

    Example:
        >>> import tempfile, fmtorch, pycolmap
        >>> path = tempfile.mkdtemp() + "/database.db"
        >>> options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=3)
        >>> with pycolmap.Database.open(path) as database:
        ...     model = pycolmap.synthesize_dataset(options, database)
        ...     database.clear_two_view_geometries()
        >>> result = fmtorch.verify(path)
        >>> result.pairs, result.verified
        (3, 3)
    """
    make = functools.partial(presets.build, "estimator", estimator, config_dir, **options)
    settings = {"estimator": estimator, "options": repr(sorted(options.items()))}
    paths = VerifyPaths(*(None if place is None else Path(place) for place in (path, features, matches, output)))
    mode = VerifyMode(cameras, lens, force, seed, execution or ONE_THREAD, shard_of(shard))
    return verify_by(make, settings, paths, mode, report or (lambda done, total: None))


class VerifyPaths(NamedTuple):
    """Where matches are, in a database, in hloc's two files or in one of matches alone, and where geometries go."""

    database: Path | None
    features: Path | None
    matches: Path | None
    output: Path | None


def verify_by(
    make: Callable[[], stages.Estimator], settings: Mapping[str, Any], paths: VerifyPaths, mode: VerifyMode,
    report: Callable[[int, int], None],
) -> Verification:  # fmt: skip
    """The same by any estimator, which `make` builds; an interrupted run is continued by one of the same `settings`."""
    begin = time.perf_counter()
    seed = int(checks.number("seed", mode.seed, integer=True))
    if mode.cameras not in get_args(Cameras):
        raise ValueError(f"cameras is {mode.cameras!r}; it must be one of {', '.join(get_args(Cameras))}")
    if mode.shard is None and not mode.force and (count := _finished(paths)):
        return Verification(paths.output or Path(), count, count, {}, (), time.perf_counter() - begin)
    arguments.expect_lens(mode.lens)
    estimator = make()
    if (gives := stages.model_of(estimator)) != "fundamental":
        raise ValueError(f"estimator gives {gives} matrices; verify needs one that gives fundamental matrices")
    if mode.lens is not None:
        arguments.expect_lenses(estimator, type(estimator).__name__)
    source: Source[stages.Estimator] = Local(estimator) if mode.execution.shared else Factory(make)
    known = "unknown" if paths.features is not None and mode.cameras == "stored" else mode.cameras
    mode = dataclasses.replace(mode, cameras=known, seed=seed)
    settings = {**settings, "version": __version__, "cameras": known, "seed": seed, "force": mode.force}
    settings |= {} if mode.lens is None else {"lens": repr(mode.lens)}
    whole = mode.shard is None
    with _opened(paths, mode.force, whole) as (store, end):
        parts = GeometryParts(end.with_name(f"{end.name}.parts"), {**settings, **store.identity()})
        run = VerificationRun(store, parts, mode)
        run.each_batch(source, report)
        if whole:
            run.write()
    if whole:
        shutil.rmtree(parts.folder)
    return run.result(end if whole else parts.folder, time.perf_counter() - begin)


def _finished(paths: VerifyPaths) -> int:
    """How many pairs an output has in which none is missing; 0 where there is no such output."""
    database, features, matches, output = paths
    if output is None or not output.exists():
        return 0
    with contextlib.suppress(ValueError, OSError, sqlite3.Error):
        if any(output.samefile(path) for path in paths[:3] if path is not None):
            return 0
        if database is not None:
            return colmap.finished_pairs(database, output)
        if matches is not None:
            with MatchFile(matches, output) if features is None else HlocMatches(features, matches, output) as files:
                return files.finished()
    return 0


@contextlib.contextmanager
def _opened(paths: VerifyPaths, force: bool, whole: bool) -> Iterator[tuple[PairStore, Path]]:
    """The store of the matches, and the file that geometries are for; whole: they are written to it."""
    database, features, matches, output = paths
    if features is not None or matches is not None:
        if database is not None or matches is None or output is None:
            raise ValueError(HLOC_NEEDS if features is not None or database is not None else MATCHES_NEED)
        _expect_files(features, matches, output, force)
        with MatchFile(matches, output) if features is None else HlocMatches(features, matches, output) as files:
            yield files, output
        return
    if database is None:
        raise ValueError("database is missing; give the database of a COLMAP project: fmtorch verify database.db")
    colmap.imported()
    colmap.expect_database(database)
    if output is not None:
        if output.exists() and output.samefile(database):
            raise ValueError(f"output={output} is the database itself; leave output out to write into it")
        if output.suffix in SUFFIXES:
            raise ValueError(f"output={output} must be a database, such as {output.with_suffix('.db').name}")
        _expect_new(output, force)
    with contextlib.ExitStack() as stack:
        work = database
        if not whole:  # many machines may read it, and SQLite writes to what it opens
            work = Path(stack.enter_context(tempfile.TemporaryDirectory())) / database.name
        elif output is not None:
            work = output.with_name(f"{output.name}.partial")
            colmap.remove_database(work)
            stack.callback(colmap.remove_database, work)
        if work == database:
            colmap.expect_writable(database)
        else:
            colmap.copy_database(database, work)
        with colmap.MatchDatabase(work, database) as store:
            yield store, output or database
        if whole and output is not None:
            colmap.move_database(work, output)


def _expect_files(features: Path | None, matches: Path, output: Path, force: bool) -> None:
    """Raises FileNotFoundError or ValueError for files that are not there, of another kind, or one and the same."""
    wanted = "give hloc's files: features=F.h5 matches=M.h5" if features else "give matches alone: matches=FILE.npz"
    if features is None:
        expect_suffix("matches", matches)
        expect_suffix("output", output)
    for path in (features, matches):
        if path is not None and not path.exists():
            raise FileNotFoundError(f"there is no file {path}; {wanted}")
        if path is not None and output.exists() and output.samefile(path):
            raise ValueError(f"output={output} is one of the files that are read; name another")
    _expect_new(output, force)


def _expect_new(output: Path, force: bool) -> None:
    if output.exists() and not force:
        raise ValueError(f"output={output} exists; name another file, or replace it with force=true")
    if not output.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {output.parent}; output={output} cannot be written")
