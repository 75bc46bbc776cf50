"""Where a verification reads and writes: databases, hloc's files, logs, and what interrupted runs and shards left."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fmtorch.core.files import replacing
from fmtorch.jobs.execution import Shard
from fmtorch.storage.exchange.database import MatchDatabase, copy_database, remove_database
from fmtorch.storage.exchange.geometry_parts import GeometryParts
from fmtorch.storage.exchange.hloc_matches import HlocMatches
from fmtorch.storage.exchange.match_file import MatchFile, expect_suffix
from fmtorch.storage.exchange.verification_log import VerificationLog


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
