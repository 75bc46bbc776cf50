"""Two-view geometries of a COLMAP database, of hloc's files, or of matches alone, whoever made them."""

import contextlib
import dataclasses
import functools
import sqlite3
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

from fmtorch import presets
from fmtorch.core.checks import number
from fmtorch.core.stages import Estimator, model_of
from fmtorch.core.version import __version__
from fmtorch.io import colmap
from fmtorch.io.match_file import HlocMatches, MatchFile, expect_suffix
from fmtorch.jobs.execution import Execution, Shard, shard_of
from fmtorch.verification.run import Cameras, Estimation, GeometryParts, PairStore, Verification, VerificationRun

ONE_THREAD = Execution("threads", 1)  # that calls an estimator, which uses as many as torch may

HLOC_NEEDS = "hloc's files need features=F.h5 matches=M.h5 output=VERIFIED.h5, and no database"
MATCHES_NEED = (
    "matches alone need an output: matches=FILE.npz output=VERIFIED.npz, with features=F.h5 where they are hloc's"
)


def verify(
    path: Path | str | None = None,
    *,
    features: Path | str | None = None,
    matches: Path | str | None = None,
    output: Path | str | None = None,
    cameras: str = "stored",
    estimator: str = "fmtorch",
    force: bool = False,
    seed: int = 0,
    config_dir: Path | str | None = None,
    report: Callable[[int, int], None] | None = None,
    execution: Execution | None = None,
    shard: str | None = None,
    **options: Any,
) -> Verification:
    """Estimate the two-view geometry of every pair with matches in a COLMAP database, as its mappers read it.

    Configuration, inlier matches, F, E, H and relative pose are written, in one transaction. Until all pairs are done a
    folder beside the database keeps them: a run that is killed leaves the database as it was, and the same call
    continues it. Keypoints, matches, cameras, rigs and frames stay as they are.

    Args:
        path: the database, of COLMAP 3 or 4, with keypoints of 2, 4 or 6 columns and cameras of any model with a lens.
        features, matches: hloc's two files in place of a database. They know no cameras; "stored" is "unknown" then.
            matches alone: an npz or HDF5 file of x0, x1 (n, 2), pixels, and perhaps K0, K1 (3, 3), size0, size1 (h, w),
            of one pair or of each pair below its name (``a/x0``). Without K and sizes a pair has F and H, but no pose.
        output: a new database to write to instead; it gets this name once it is complete, and is left as it is where it
            has all pairs. Of hloc's files a new file of matches, those that are inliers, with the matrices as
            attributes. Of matches alone an npz or HDF5 file of each pair's `configuration`, `inliers` (n,), and F, E,
            H, R, t, `reason` and `warning` as far as it has them.
        cameras: "stored": points are undistorted, focal lengths are exact where the camera was calibrated, known within
            5 % where they have a prior and nothing else is known of the camera (EXIF), and unknown where they are
            COLMAP's guess; images of one camera share theirs. "shared": all images have one unknown focal length in
            units of the longer side, without distortion. "unknown": nothing is known.
        estimator: a preset of conf/estimator.
        force: estimate pairs that have a geometry as well, and replace an existing `output`.
        seed: of the random numbers.
        config_dir: a folder with presets of your own, as of `find_fundamental`.
        report: called with the pairs done and their number, at the start and after each batch.
        execution: by which workers, ``fmtorch.jobs.execution.Execution("processes", 4)`` say; None: threads of the
            estimator. All that is written this process writes.
        shard: "2/8" for the second eighth of the pairs. A call without it estimates what is missing and writes all.
        options: replace values of the preset (``inlier_threshold=1.0``).

    Returns:
        A `Verification` with counts and problems.

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
    mode = VerifyMode(cameras, force, seed, execution or ONE_THREAD, shard_of(shard))
    return verify_by(make, settings, paths, mode, report)


class VerifyPaths(NamedTuple):
    """Where matches are, in a database, in hloc's two files or in one of matches alone, and where geometries go."""

    database: Path | None
    features: Path | None
    matches: Path | None
    output: Path | None


@dataclasses.dataclass(frozen=True)
class VerifyMode:
    """How pairs are verified: what is taken for known of cameras, what is replaced, by whom, and which pairs."""

    cameras: str = "stored"
    force: bool = False
    seed: int = 0
    execution: Execution = ONE_THREAD
    shard: Shard | None = None


def verify_by(
    make: Callable[[], Estimator], settings: Mapping[str, Any], paths: VerifyPaths, mode: VerifyMode,
    report: Callable[[int, int], None] | None,
) -> Verification:  # fmt: skip
    """The same by any estimator, which `make` builds; an interrupted run is continued by one of the same `settings`."""
    begin = time.perf_counter()
    seed = int(number("seed", mode.seed, integer=True))
    if mode.cameras not in get_args(Cameras):
        raise ValueError(f"cameras is {mode.cameras!r}; it must be one of {', '.join(get_args(Cameras))}")
    if mode.shard is None and not mode.force and (count := _finished(paths)):
        return Verification(paths.output or Path(), count, count, {}, (), time.perf_counter() - begin)
    estimator = make()
    if (gives := model_of(estimator)) != "fundamental":
        raise ValueError(f"estimator gives {gives} matrices; verify needs one that gives fundamental matrices")
    if mode.execution.shared:
        make = functools.partial(_same, estimator)
    known = "unknown" if paths.features is not None and mode.cameras == "stored" else mode.cameras
    settings = {**settings, "version": __version__, "cameras": known, "seed": seed, "force": mode.force}
    whole = mode.shard is None
    with _opened(paths, mode.force, whole) as (store, end):
        parts = GeometryParts(end.with_name(f"{end.name}.parts"), {**settings, **store.identity()})
        run = VerificationRun(store, parts, mode.shard, mode.force)
        run.each_batch(functools.partial(_estimation, make, cast(Cameras, known), seed), mode.execution, report)
        if whole:
            run.write()
    if whole:
        parts.remove()
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


def _same(estimator: Estimator) -> Estimator:
    return estimator


def _estimation(make: Callable[[], Estimator], cameras: Cameras, seed: int) -> Estimation:
    return Estimation(make(), cameras, seed)


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
        _expect_new(output, force)
    with contextlib.ExitStack() as stack:
        work = database
        if not whole:  # many machines may read it, and SQLite writes to what it opens
            work = Path(stack.enter_context(tempfile.TemporaryDirectory())) / database.name
        elif output is not None:
            work = output.with_name(f"{output.name}.partial")
            colmap.remove_database(work)
        if work == database:
            colmap.expect_writable(database)
        else:
            colmap.copy_database(database, work)
        with colmap.MatchDatabase(work) as store:
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
