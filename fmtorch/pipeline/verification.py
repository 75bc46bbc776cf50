"""Two-view geometries of a COLMAP database, of hloc's files, or of matches alone, whoever made them."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast, get_args

from fmtorch import presets
from fmtorch.core.arguments import number
from fmtorch.core.files import replacing
from fmtorch.core.stages import Estimator, model_of
from fmtorch.core.version import __version__
from fmtorch.pipeline.database_pairs import Cameras
from fmtorch.pipeline.verification_run import Verification, VerificationRun
from fmtorch.storage.exchange.colmap import imported
from fmtorch.storage.exchange.database import (
    MatchDatabase,
    copy_database,
    expect_database,
    move_database,
    remove_database,
)
from fmtorch.storage.exchange.hloc_matches import HlocMatches
from fmtorch.storage.exchange.match_file import MatchFile, expect_suffix
from fmtorch.storage.exchange.verification_log import VerificationLog

Store = TypeVar("Store", HlocMatches, MatchFile)
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
    built = presets.build("estimator", estimator, config_dir, **options)
    settings = {"estimator": estimator, "options": repr(sorted(options.items()))}
    places = Places(*(None if place is None else Path(place) for place in (path, features, matches, output)))
    return verify_by(built, settings, places, cameras, force, seed, report)


class Places(NamedTuple):
    """Where matches are, in a database, in hloc's two files or in one of matches alone, and where geometries go."""

    database: Path | None
    features: Path | None
    matches: Path | None
    output: Path | None


def verify_by(
    estimator: Estimator, settings: Mapping[str, Any], places: Places, cameras: str, force: bool, seed: int,
    report: Callable[[int, int], None] | None,
) -> Verification:  # fmt: skip
    """The same by an estimator that is built; an interrupted run is continued by one of the same `settings`."""
    begin = time.perf_counter()
    seed = int(number("seed", seed, whole=True))
    if cameras not in get_args(Cameras):
        raise ValueError(f"cameras is {cameras!r}; it must be one of {', '.join(get_args(Cameras))}")
    known: Cameras = cast(Cameras, cameras)
    if (gives := model_of(estimator)) != "fundamental":
        raise ValueError(f"estimator gives {gives} matrices; verify needs one that gives fundamental matrices")
    settings = {**settings, "version": __version__, "cameras": cameras, "seed": seed, "force": force}
    path, features, matches, output = places
    if features is not None or matches is not None:
        if path is not None or matches is None or output is None:
            raise ValueError(HLOC_NEEDS if features is not None or path is not None else MATCHES_NEED)
        store: HlocMatches | MatchFile
        if features is None:
            store = _opened_matches(matches, output, settings, force)
        else:
            store = _opened_hloc(features, matches, output, settings, force)
            known = "unknown" if known == "stored" else known
        with store:
            run = VerificationRun(store, known, seed, estimator)
            run.each_batch(report)
            store.finish(output)
        _log_of(output).unlink(missing_ok=True)
        return run.result(output, time.perf_counter() - begin)
    if path is None:
        raise ValueError("database is missing; give the database of a COLMAP project: fmtorch verify database.db")
    imported()
    expect_database(path)
    work, log = _opened(path, output, settings, force)
    with MatchDatabase(work) as database:
        run = VerificationRun(database, known, seed, estimator, log if force else None)
        run.each_batch(report)
    if output is not None:
        move_database(work, output)
    if log is not None:
        log.remove()
    return run.result(output or path, time.perf_counter() - begin)


def _opened(
    path: Path, output: Path | None, settings: Mapping[str, Any], force: bool
) -> tuple[Path, VerificationLog | None]:
    """The database to write to, and the log of the pairs that are done in it: of a copy, or where all are forced."""
    if output is None:
        if not force:
            return path, None
        with MatchDatabase(path) as database:
            settings = {**settings, **database.counts()}
        return path, VerificationLog(_log_of(path), settings)
    if output.exists() and output.samefile(path):
        raise ValueError(f"output={output} is the database itself; leave output out to write into it")
    _expect_new(output, force)
    work = _work_of(output)
    log = VerificationLog(_log_of(output), {**settings, **_states(path)})
    if not (log.continued and work.exists()):
        remove_database(work)
        log.done.clear()
        with replacing(work) as temporary:
            copy_database(path, temporary)
    return work, log


def _opened_hloc(features: Path, matches: Path, output: Path, settings: Mapping[str, Any], force: bool) -> HlocMatches:
    """hloc's files, with what an interrupted run of the same settings found of them."""
    sources = (features, matches)
    _expect_sources(sources, output, "give hloc's files: features=F.h5 matches=M.h5")
    return _with_parts(HlocMatches, sources, output, settings, force)


def _opened_matches(matches: Path, output: Path, settings: Mapping[str, Any], force: bool) -> MatchFile:
    """A file of matches alone, likewise."""
    expect_suffix("matches", matches)
    expect_suffix("output", output)
    _expect_sources((matches,), output, "give matches alone: matches=FILE.npz")
    return _with_parts(MatchFile, (matches,), output, settings, force)


def _expect_sources(paths: Sequence[Path], output: Path, wanted: str) -> None:
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"there is no file {path}; {wanted}")
        if output.exists() and output.samefile(path):
            raise ValueError(f"output={output} is one of the files that are read; name another")


def _with_parts(
    kind: Callable[..., Store], sources: Sequence[Path], output: Path, settings: Mapping[str, Any], force: bool
) -> Store:
    """Files and the folder of what is found of them, which is emptied unless a run of the same settings ended early."""
    _expect_new(output, force)
    parts, log = _work_of(output), VerificationLog(_log_of(output), {**settings, **_states(*sources)})
    if not log.continued:
        shutil.rmtree(parts, ignore_errors=True)
    try:
        return kind(*sources, parts)
    except ValueError:
        if not parts.exists():
            log.remove()
        raise


def _expect_new(output: Path, force: bool) -> None:
    if output.exists() and not force:
        raise ValueError(f"output={output} exists; name another file, or replace it with force=true")
    if not output.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {output.parent}; output={output} cannot be written")


def _work_of(output: Path) -> Path:
    return output.with_name(f"{output.name}.partial")


def _log_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.verification")


def _states(*paths: Path) -> dict[str, Any]:
    """What tells whether files have changed."""
    states = [(str(path.absolute()), path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    return {"sources": [list(state) for state in states]}
