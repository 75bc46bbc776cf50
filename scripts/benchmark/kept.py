"""Rows that a benchmark keeps as it makes them, so that an interrupted run goes on where it stopped."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra.utils

from fmtorch.presets import load, peer_packages, targets_of
from fmtorch.presets.objects import merged
from fmtorch.runs import identity_digest
from fmtorch.runs.fingerprint import code_digest, learned, libraries

Row = dict[str, Any]
Stages = list[tuple[str, str, Mapping[str, Any]]]  # group, preset and changed options of each
DIGITS = 16  # of an identity


class Kept:
    """The rows of one benchmark, appended to a file of JSON lines as they are made.

    Args:
        path: the file, with the rows of earlier runs if there are some; a last line that was cut off by an
            interruption is removed. None: rows are kept in memory only.

    Raises:
        SystemExit: where the folder does not exist or the file holds anything else.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.rows: list[Row] = []
        if path is None:
            return
        if not path.parent.is_dir():
            raise SystemExit(f"{path}: there is no folder {path.parent}")
        if path.exists():
            self.rows = read(path)
            with path.open("r+b") as file:
                file.truncate(len(_whole_lines(path)))

    def add(self, rows: Sequence[Row]) -> None:
        """Keep some rows, together: an interruption loses all of them or none."""
        self.rows += rows
        if self.path is not None:
            with self.path.open("a", encoding="utf-8") as file:
                file.write("".join(json.dumps(row) + "\n" for row in rows))

    def by(self, *fields: str) -> dict[tuple[Any, ...], Row]:
        """The rows by the values of some fields, of equals the last; rows that lack a field are left out."""
        return {tuple(row[f] for f in fields): row for row in self.rows if all(f in row for f in fields)}


def read(path: Path) -> list[Row]:
    """The rows of a file, without a last line that was cut off. Raises SystemExit for a file of anything else."""
    if not path.is_file():
        raise SystemExit(f"{path}: no such file")
    rows = []
    for number, line in enumerate(_whole_lines(path).decode("utf-8", errors="replace").splitlines(), 1):
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            row = None
        if not isinstance(row, dict):
            raise SystemExit(f"{path}, line {number}: no row of a benchmark, one JSON object a line; name another file")
        rows.append(row)
    return rows


def _whole_lines(path: Path) -> bytes:
    content = path.read_bytes()
    return content[: content.rfind(b"\n") + 1]


def identity(stages: Stages, *others: Any) -> str:
    """The digest of what defines the results of some stages.

    Args:
        stages: e.g. ``[("estimator", "usac", {"threshold": 1.0})]``.
        others: stages without a preset, of which only the learned files count, and plain values.

    Returns:
        The digest of their options, their code, the versions of peers' packages, and the learned files.
    """
    configs = [merged(load(group, name), options) for group, name, options in stages]
    targets = sorted(targets_of(configs))
    modules = {target: str(hydra.utils.get_object(target).__module__) for target in targets}
    plain = [other if isinstance(other, bool | int | float | str | None) else learned(other) for other in others]
    made_with = {
        "stages": configs, "code": {target: code_digest(module) for target, module in modules.items()},
        "libraries": libraries(peer_packages(configs)), "others": plain,
    }  # fmt: skip
    return identity_digest(made_with)[:DIGITS]
