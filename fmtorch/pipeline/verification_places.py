"""Where a verification reads and writes: databases, hloc's files, logs, and what interrupted runs and shards left."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fmtorch.core.files import replacing
from fmtorch.core.shards import Shard
from fmtorch.storage.exchange.database import MatchDatabase, copy_database, remove_database
from fmtorch.storage.exchange.geometry_parts import GeometryParts
from fmtorch.storage.exchange.hloc_matches import HlocMatches
from fmtorch.storage.exchange.verification_log import VerificationLog


class Places(NamedTuple):
    """Where matches are, in a database or in hloc's two files, and where geometries go."""

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


def opened_hloc(
    features: Path, matches: Path, output: Path, settings: Mapping[str, Any], force: bool, shard: Shard | None
) -> HlocMatches:
    """hloc's files, with what an interrupted run of the same settings found of them."""
    for path in (features, matches):
        if not path.exists():
            raise FileNotFoundError(f"there is no file {path}; give hloc's files: features=F.h5 matches=M.h5")
        if output.exists() and output.samefile(path):
            raise ValueError(f"output={output} is one of the files that are read; name another")
    _expect_new(output, force)
    if shard is not None:
        return HlocMatches(features, matches, work_of(output))
    log = VerificationLog(log_of(output), {**settings, **_states(features, matches)})
    if not log.continued:
        shutil.rmtree(work_of(output), ignore_errors=True)
    return HlocMatches(features, matches, work_of(output))


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
