"""Files that are either whole or absent, folders of one setting alone, and those of configuration and caches."""

import contextlib
import json
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any


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
STAGES: dict[str, str | list[str]] = {  # the groups of presets that a pipeline chooses from, each with its default
    "features": "sift", "matcher": "nearest", "pruner": ["ratio", "one_to_one"], "estimator": "ransac",
}  # fmt: skip


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


SHOWN = 5  # differing fields, or names, that an error shows


def canonical(settings: Mapping[str, Any]) -> str:
    """The one JSON text of settings: sorted keys, no spaces, floats by `repr`. Raises TypeError where JSON has none."""
    return json.dumps(settings, sort_keys=True, separators=(",", ":"))


def claim(file: Path, settings: Mapping[str, Any], holds: str, instead: str, alone: bool = True) -> None:
    """Make the folder of a file, and the file, which keeps settings as JSON, or see that it is a folder of these.
    Of several processes the first one writes it. holds: what is in such a folder; instead: what to do where it is of
    other settings; both for messages. alone: refuse a folder without the file that is not empty. Raises ValueError for
    a folder of other settings, naming what differs, and for one that holds something else."""
    folder, wanted = file.parent, json.loads(canonical(settings))
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file; {instead}")
    folder.mkdir(parents=True, exist_ok=True)
    if not file.exists():
        foreign = sorted(entry.name for entry in folder.iterdir() if entry.suffix != ".tmp")
        if alone and foreign:
            what = f"has no {file.name}, so it holds no {holds} (it holds {head(foreign)})"
            raise ValueError(f"{folder} is not empty and {what}; {instead}")
        create(file, json.dumps(wanted, indent=2) + "\n")
    try:
        stored = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file} is not valid JSON ({error}); delete {folder} and run again") from error
    if stored != wanted:
        what = f"what differs (there -> now): {differences(stored, wanted)}"
        raise ValueError(f"{folder} holds {holds} of other settings; {what}. {instead[0].upper()}{instead[1:]}")


def create(file: Path, text: str) -> None:
    """Write a file unless another process just has: of several the first wins, without hard links the last."""
    temporary = temporary_name(file)
    try:
        with naming(file, temporary):
            temporary.write_text(text, encoding="utf-8")
            sync(temporary)
        try:
            os.link(temporary, file)  # unlike a rename it fails where the name is taken
        except FileExistsError:
            return
        except OSError:
            os.replace(temporary, file)
        sync(file.parent)
    finally:
        temporary.unlink(missing_ok=True)


def differences(old: Any, new: Any) -> str:
    """``a.b: 1 -> 2`` for the first few fields that differ, and how many more there are."""
    before, after = dict(leaves(old)), dict(leaves(new))
    names = [*before, *(name for name in after if name not in before)]
    pairs = [(name, before.get(name, "(absent)"), after.get(name, "(absent)")) for name in names]
    return head([f"{name}: {was} -> {now}" for name, was, now in pairs if was != now])


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Dotted names and JSON texts of all that nested settings hold.
    A list of mappings of one name each, such as a pipeline's pruners, is their order, and what is below each."""
    if isinstance(value, list) and value and all(isinstance(entry, dict) and len(entry) == 1 for entry in value):
        yield name, f"[{', '.join([key for entry in value for key in entry])}]"
        value = {key: below for entry in value for key, below in entry.items()}
    if isinstance(value, dict) and value:
        for key, entry in value.items():
            yield from leaves(entry, f"{name}.{key}" if name else key)
    else:
        yield name, json.dumps(value, sort_keys=True)


def counted(n: int, noun: str) -> str:
    """``1 pair``, ``2 pairs``, ``2 matches``."""
    return f"{n} {noun}" + ("" if n == 1 else "es" if noun.endswith("ch") else "s")


def head(items: Sequence[str]) -> str:
    """The first few items, and how many more there are."""
    more = len(items) - SHOWN
    return "; ".join(items[:SHOWN]) + (f"; and {more} more" if more > 0 else "")
