"""Rows of the stress test: which are compared at a level, and their figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.evaluation.statistics import scene_names
from fmtorch.presets.pruners import WIDE
from fmtorch.scenes.generate import FAMILIES
from scripts.benchmark.stress_changes import CONDITIONS

Row = dict[str, Any]
Level = float | str
GROUPS = ("real, wide", "real, short", "rendered")
PLANE, TURN = 0.8, 0.02


def group(family: str) -> str:
    """Which of GROUPS a family belongs to."""
    if family in FAMILIES:
        return "rendered"
    return "real, wide" if family in WIDE else "real, short"


def comparable(rows: Sequence[Row], order: Sequence[str] = ()) -> list[Row]:
    """The rows of the pairs that all estimators have at a level, with as many seeds in all rows of an estimator.

    order: estimators that come first, in this order.
    """
    names = [name for name in dict.fromkeys([*order, *methods(rows)]) if name in set(methods(rows))]
    by_cell: dict[tuple[str, str, Level], dict[str, Row]] = {}
    for row in rows:
        by_cell.setdefault((row["sweep"], row["pair"], row["level"]), {})[row["method"]] = row
    wanted = {sweep: set(methods([r for r in rows if r["sweep"] == sweep])) for sweep in {r["sweep"] for r in rows}}
    complete = [cell for (sweep, *_), cell in by_cell.items() if cell.keys() >= wanted[sweep]]
    seeds = {name: min((len(cell[name]["nsgd"]) for cell in complete if name in cell), default=0) for name in names}
    return [
        cell[name] | {figure: cell[name][figure][: seeds[name]] for figure in ("nsgd", "ms")}
        for name in names for cell in complete if name in cell
    ]  # fmt: skip


def label(method: str) -> str:
    """An estimator's name in tables: without its stages and the options that all of its kind have."""
    front, _, stages = method.partition("@")
    name, _, rest = front.partition(":")
    distinguishing = [
        option for option in rest.split(",") if option and option.partition("=")[0] not in ("threshold", "prosac")
    ]
    return ", ".join([name, *distinguishing, *(["no sizes"] if "sizeless" in stages else [])])


def methods(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["method"] for row in rows))


def levels(rows: Sequence[Row]) -> list[Level]:
    """In the order of the sweep; after conditions, which of the unchanged pairs show a plane or little translation."""
    present = list(dict.fromkeys(row["level"] for row in rows))
    if all(isinstance(level, float) for level in present):
        return sorted(present)
    ordered = [name for name in CONDITIONS if name in present]
    return [*ordered, *(name for name in NATURAL if at(rows, name))]


def flat(row: Row) -> bool:
    """Whether one homography explains more than PLANE of the right matches: of a plane, or without translation."""
    return bool(row["plane"] > PLANE)


def turned(row: Row) -> bool:
    """Whether rotation alone explains the right matches to within TURN of the longer image side, in the median."""
    return bool(row["parallax"] < TURN * row["side"])


NATURAL: dict[str, Callable[[Row], bool]] = {
    "of these: one homography": lambda row: flat(row) and not turned(row),
    "of these: rotation": lambda row: flat(row) and turned(row),
}
"""Unchanged pairs of which one homography explains nearly everything; the second, with next to no parallax."""


def at(rows: Sequence[Row], level: Level) -> list[Row]:
    """The rows of a level."""
    if level in NATURAL:
        return [row for row in rows if row["level"] == "as they are" and NATURAL[str(level)](row)]
    return [row for row in rows if row["level"] == level]


def count(rows: Sequence[Row], level: Level) -> int:
    return len({row["pair"] for row in at(rows, level)})


def figures(rows: Sequence[Row], method: str, level: Level) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """NSGD and milliseconds (seeds, pairs) of an estimator at a level."""
    own = [row for row in at(rows, level) if row["method"] == method]
    return np.array([row["nsgd"] for row in own]).T, np.array([row["ms"] for row in own]).T


def paired(
    rows: Sequence[Row], first: str, second: str, level: Level
) -> tuple[tuple[NDArray[np.float64], list[str]], tuple[NDArray[np.float64], list[str]]]:
    """NSGD (seeds, pairs) of two estimators on the pairs that both have, with the pairs' scenes."""
    by_method = {m: {r["pair"]: r for r in at(rows, level) if r["method"] == m} for m in (first, second)}
    both = [pair for pair in by_method[first] if pair in by_method[second]]
    measured = []
    for method in (first, second):
        own = [by_method[method][pair] for pair in both]
        scenes = scene_names([row["family"] for row in own], [row["scene"] for row in own])
        measured.append((np.array([row["nsgd"] for row in own]).T, scenes))
    return measured[0], measured[1]
