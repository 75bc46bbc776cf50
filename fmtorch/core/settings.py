"""Settings as plain values: their one JSON text, what differs between two, and folders that are of one alone."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from fmtorch.core.files import naming, sync, temporary_name

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
    """Write a file unless another process has just done so: of several, the first one wins.
    Where the file system has no hard links the last one wins."""
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


def head(items: Sequence[str]) -> str:
    """The first few items, and how many more there are."""
    more = len(items) - SHOWN
    return "; ".join(items[:SHOWN]) + (f"; and {more} more" if more > 0 else "")
