"""Files that are either whole or absent, and the folders of configuration, networks and caches."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path` to write to; on leaving it becomes `path`, after an error it is removed.
    A process that dies in between leaves at most a file that ends in ``.tmp``. Safe with several writers: each has a
    name of its own, and the last one to leave wins. An OSError within, such as of a full disk, names `path`."""
    temporary = temporary_name(path)
    try:
        with naming(path, temporary):
            yield temporary
            sync(temporary)
            os.replace(temporary, path)
            sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file of text in UTF-8, or of bytes, whole or not at all: see `replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def expect_writable(folder: Path) -> None:
    """Make a folder, and raise OSError where no file can be written to it: before the work, not after."""
    folder.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(folder / "write")
    with naming(folder, temporary):
        temporary.touch()
        temporary.unlink()


@contextlib.contextmanager
def naming(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Within it an OSError that names no file, or the temporary one for it, names `path`: what a full disk says."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename not in (None, temporary, str(temporary)):
            raise
        raise OSError(error.errno, error.strerror or os.strerror(error.errno), str(path)) from error


def temporary_name(path: Path) -> Path:
    """A name beside `path` that no other writer has."""
    return path.with_name(f"{path.name}.{uuid.uuid4().hex}.tmp")


def sync(path: Path) -> None:
    """Wait until a file's contents, or a folder's entries, are on the disk."""
    if path.is_dir() and os.name == "nt":
        return  # Windows cannot open folders
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


PACKAGE = Path(__file__).resolve().parents[1]
STAGES: dict[str, str | list[str]] = {
    "features": "sift", "matcher": "nearest", "pruner": ["ratio", "one_to_one"], "estimator": "ransac",
}  # fmt: skip
"""The groups of presets that a pipeline chooses from, with what stands where nothing is chosen."""


def _folder(name: str) -> Path:
    checkout = PACKAGE.parent if (PACKAGE.parent / "pyproject.toml").is_file() else PACKAGE
    for folder in (PACKAGE / name, checkout / name):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"no folder {name!r} in {PACKAGE} or beside it: the installation is incomplete")


def conf_dir() -> Path:
    """The folder of Hydra groups."""
    return _folder("conf")


def models_dir() -> Path:
    """The folder of shipped networks and other learned files."""
    return _folder("models")


def cache_dir() -> Path:
    """Where generated data and features are kept: $FMTORCH_CACHE, or fmtorch in the user's cache folder."""
    chosen = os.environ.get("FMTORCH_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "fmtorch"
