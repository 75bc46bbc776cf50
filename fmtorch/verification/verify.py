"""Where a verification reads and writes: databases, hloc's files, logs, and what interrupted runs and shards left."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

from fmtorch import presets
from fmtorch.core.checks import number
from fmtorch.core.files import replacing
from fmtorch.core.stages import Estimator, model_of
from fmtorch.core.version import __version__
from fmtorch.io.colmap import MatchDatabase, copy_database, expect_database, imported, move_database, remove_database
from fmtorch.io.hloc import HlocMatches
from fmtorch.io.match_file import MatchFile, expect_suffix
from fmtorch.jobs.execution import Execution, Shard, shard_of
from fmtorch.verification.run import Cameras, Estimation, GeometryParts, Verification, VerificationLog, VerificationRun


class Places(NamedTuple):
    """Where matches are, in a database, in hloc's two files or in one of matches alone, and where geometries go."""

    database: Path | None
    features: Path | None
    matches: Path | None
    output: Path | None


def opened(
    path: Path, output: Path | None, settings: Mapping[str, Any], force: bool
) -> tuple[Path, VerificationLog | None]:
    """The database to write to, and the log of the pairs that are done in it: of a copy, or where all are forced."""
    if output is None:
        if not force:
            return path, None
        with MatchDatabase(path) as database:
            settings = {**settings, **database.counts()}
        return path, VerificationLog(log_of(path), settings)
    if output.exists() and output.samefile(path):
        raise ValueError(f"output={output} is the database itself; leave output out to write into it")
    _expect_new(output, force)
    work = work_of(output)
    log = VerificationLog(log_of(output), {**settings, **_states(path)})
    if not (log.continued and work.exists()):
        remove_database(work)
        log.done.clear()
        with replacing(work) as temporary:
            copy_database(path, temporary)
    return work, log


def opened_files(
    features: Path | None, matches: Path, output: Path, settings: Mapping[str, Any], force: bool, shard: Shard | None
) -> HlocMatches | MatchFile:
    """hloc's files, or one of matches alone, with what an interrupted run of the same settings found of them."""
    wanted = "give hloc's files: features=F.h5 matches=M.h5" if features else "give matches alone: matches=FILE.npz"
    if features is None:
        expect_suffix("matches", matches)
        expect_suffix("output", output)
    sources = [path for path in (features, matches) if path is not None]
    for path in sources:
        if not path.exists():
            raise FileNotFoundError(f"there is no file {path}; {wanted}")
        if output.exists() and output.samefile(path):
            raise ValueError(f"output={output} is one of the files that are read; name another")
    _expect_new(output, force)
    parts, log = work_of(output), None
    if shard is None:
        log = VerificationLog(log_of(output), {**settings, **_states(*sources)})
        if not log.continued:
            shutil.rmtree(parts, ignore_errors=True)
    try:
        return MatchFile(matches, parts) if features is None else HlocMatches(features, matches, parts)
    except ValueError:
        if log is not None and not parts.exists():
            log.remove()
        raise


def _expect_new(output: Path, force: bool) -> None:
    if output.exists() and not force:
        raise ValueError(f"output={output} exists; name another file, or replace it with force=true")
    if not output.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {output.parent}; output={output} cannot be written")


def work_of(output: Path) -> Path:
    """What becomes `output` once it is complete."""
    return output.with_name(f"{output.name}.partial")


def log_of(path: Path) -> Path:
    """The log of what is done of a database or file."""
    return path.with_name(f"{path.name}.verification")


def _states(*paths: Path) -> dict[str, Any]:
    """What tells whether files have changed."""
    states = [(str(path.absolute()), path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    return {"sources": [list(state) for state in states]}


def parts_of(path: Path, settings: Mapping[str, Any], shard: Shard | None) -> GeometryParts | None:
    """The folder of shards beside a database or file; None where there is none, and none is needed."""
    folder = path.with_name(f"{path.name}.shards")
    return GeometryParts(folder, settings) if shard is not None or folder.is_dir() else None


# Two-view geometries of a COLMAP database, of hloc's files, or of matches alone, whoever made them


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

    Configuration, inlier matches, F, E, H and relative pose are written, batch by batch in transactions: a run that is
    killed leaves a database that can be read, and the same call continues it. Keypoints, matches, cameras, rigs and
    frames stay as they are.

    Args:
        path: the database, of COLMAP 3 or 4, with keypoints of 2, 4 or 6 columns and cameras of any model with a lens.
        features, matches: hloc's two files in place of a database. They know no cameras; "stored" is "unknown" then.
            matches alone: an npz or HDF5 file of x0, x1 (n, 2), pixels, and perhaps K0, K1 (3, 3), size0, size1 (h, w),
            of one pair or of each pair below its name (``a/x0``). Without K and sizes a pair has F and H, but no pose.
        output: a new database to write to instead; it gets this name once it is complete. Of hloc's files a new file of
            matches, those that are inliers, with the matrices as attributes. Of matches alone an npz or HDF5 file of
            each pair's `configuration`, `inliers` (n,), and F, E, H, R, t as far as it has them.
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
        shard: "2/8" for the second eighth of the pairs. Geometries go to a folder beside the database, whence a call
            without `shard` merges them and estimates what is missing.
        options: replace values of the preset (``inlier_threshold=1.0``).

    Returns:
        A `Verification` with counts and problems.

    Raises:
        FileNotFoundError: where there is no database.
        ValueError: for another file, a database of a newer COLMAP, without keypoints or without matches; for an
            `output` that exists, an unknown preset, option or kind of cameras.
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
    places = Places(*(None if place is None else Path(place) for place in (path, features, matches, output)))
    how = How(cameras, force, seed, execution or ONE_THREAD, shard_of(shard))
    return verify_by(make, settings, places, how, report)


@dataclasses.dataclass(frozen=True)
class How:
    """How pairs are verified: what is taken for known of cameras, what is replaced, by whom, and which pairs."""

    cameras: str = "stored"
    force: bool = False
    seed: int = 0
    execution: Execution = ONE_THREAD
    shard: Shard | None = None


def verify_by(
    make: Callable[[], Estimator], settings: Mapping[str, Any], places: Places, how: How,
    report: Callable[[int, int], None] | None,
) -> Verification:  # fmt: skip
    """The same by any estimator, which `make` builds; an interrupted run is continued by one of the same `settings`."""
    begin = time.perf_counter()
    seed = int(number("seed", how.seed, integer=True))
    if how.cameras not in get_args(Cameras):
        raise ValueError(f"cameras is {how.cameras!r}; it must be one of {', '.join(get_args(Cameras))}")
    estimator = make()
    if (gives := model_of(estimator)) != "fundamental":
        raise ValueError(f"estimator gives {gives} matrices; verify needs one that gives fundamental matrices")
    settings = {**settings, "version": __version__, "cameras": how.cameras, "seed": seed, "force": how.force}
    path, features, matches, output = places
    known = cast(Cameras, how.cameras)
    if how.execution.shared:
        make = functools.partial(_same, estimator)
    if features is not None or matches is not None:
        if path is not None or matches is None or output is None:
            raise ValueError(HLOC_NEEDS if features is not None or path is not None else MATCHES_NEED)
        known = "unknown" if features is not None and known == "stored" else known
        with opened_files(features, matches, output, settings, how.force, how.shard) as store:
            parts = parts_of(output, {**settings, "pairs": len(store.pairs())}, how.shard)
            run = VerificationRun(store, None, how.shard, parts)
            run.each_batch(functools.partial(_estimation, make, known, seed), how.execution, report)
            if how.shard is None:
                store.finish(output)
        if how.shard is None:
            log_of(output).unlink(missing_ok=True)
        return _finished(run, parts, output, how.shard, begin)
    estimation = functools.partial(_estimation, make, known, seed)
    if path is None:
        raise ValueError("database is missing; give the database of a COLMAP project: fmtorch verify database.db")
    imported()
    expect_database(path)
    with contextlib.ExitStack() as stack:
        if how.shard is None:
            work, log = opened(path, output, settings, how.force)
        else:  # many machines may read it, and SQLite writes to what it opens
            work, log = Path(stack.enter_context(tempfile.TemporaryDirectory())) / path.name, None
            copy_database(path, work)
        database = stack.enter_context(MatchDatabase(work))
        parts = parts_of(output or path, {**settings, **database.counts()}, how.shard)
        run = VerificationRun(database, log if how.force else None, how.shard, parts, again=how.force)
        run.each_batch(estimation, how.execution, report)
    if output is not None and how.shard is None:
        move_database(work, output)
    if log is not None:
        log.remove()
    return _finished(run, parts, output or path, how.shard, begin)


def _same(estimator: Estimator) -> Estimator:
    return estimator


def _estimation(make: Callable[[], Estimator], cameras: Cameras, seed: int) -> Estimation:
    return Estimation(make(), cameras, seed)


def _finished(
    run: VerificationRun, parts: GeometryParts | None, path: Path, shard: Shard | None, begin: float
) -> Verification:
    """The summary; the folder of shards goes once it is merged."""
    if parts is not None and shard is None:
        parts.remove()
    where = parts.folder if parts is not None and shard is not None else path
    return run.result(where, time.perf_counter() - begin)
