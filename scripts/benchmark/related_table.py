"""Tables of `scripts/benchmark related`: rules beside each other, levels, and families."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from fmtorch.core.types import RELATED
from fmtorch.evaluation.statistics import share_interval

Row = dict[str, Any]
RIGHT = 0.05  # NSGD below which an estimate of a related pair is right
LEVELS = (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 5.0, 8.0)

RULES: dict[str, Callable[[Row], bool]] = {
    "COLMAP's": lambda row: inliers(row) >= 15 and inliers(row) >= 0.25 * row["matches"],
    "15 inliers": lambda row: inliers(row) >= 15,
    "20 inliers": lambda row: inliers(row) >= 20,
}
"""What others accept a pair by. COLMAP's default: 15 inliers that are a quarter of the matches."""


def text(rows: dict[str, list[Row]]) -> str:
    """The tables as Markdown."""
    note = (
        f"At level {RELATED:g}: unrelated pairs accepted and right ones (NSGD < {RIGHT}) rejected, in %, with score "
        "intervals (95 %).\nOther rules: accepted / rejected; COLMAP's is 15 inliers that are a quarter of the matches "
        "or more. `ok`: unrelated\npairs with an F. Area: under the ROC curve of right against unrelated pairs."
    )
    return "\n\n".join([note, rules(rows), levels(rows), families(rows)])


def rules(rows: dict[str, list[Row]]) -> str:
    """Each rule: the share of unrelated pairs that it accepts, and of right estimates that it rejects."""
    heads = ["", "unrelated", "right", "`ok`", "accepted", "rejected", *RULES, "area", "area, inliers"]
    lines = []
    for name, own in rows.items():
        unrelated, right = split(own)
        cells: list[object] = [f"`{name}`", len(unrelated), len(right), percent([r["ok"] for r in unrelated])]
        cells += [share(unrelated, _related), share(right, lambda row: not _related(row))]
        for rule in RULES.values():
            cells.append(f"{percent([rule(r) for r in unrelated])} / {percent([not rule(r) for r in right])}")
        cells += [f"{area(right, unrelated, figure):.5f}" for figure in (significance, inliers)]
        lines.append(cells)
    return table(heads, lines)


def levels(rows: dict[str, list[Row]]) -> str:
    """Points of the ROC curve: unrelated pairs accepted and right ones rejected at several levels."""
    lines = []
    for name, own in rows.items():
        unrelated, right = split(own)
        cells: list[object] = [f"`{name}`"]
        for level in LEVELS:
            accepted = percent([significance(r) >= level for r in unrelated])
            cells.append(f"{accepted} / {percent([significance(r) < level for r in right])}")
        lines.append(cells)
    return table(["accepted / rejected at level", *(f"{level:g}" for level in LEVELS)], lines)


def families(rows: dict[str, list[Row]]) -> str:
    """By family: pairs called related, those whose estimate is right and those whose is not."""
    lines: list[list[object]] = []
    names = sorted({row["family"] for own in rows.values() for row in own})
    for family in names:
        cells: list[object] = [family]
        for own in rows.values():
            members = [row for row in own if row["family"] == family]
            right = [_related(row) for row in members if row["true"] and row["nsgd"] < RIGHT]
            wrong = [_related(row) for row in members if not (row["true"] and row["nsgd"] < RIGHT)]
            cells.append(f"{sum(right)} of {len(right)}; {sum(wrong)} of {len(wrong)}")
        lines.append(cells)
    return table(["called related: right ones; others", *(f"`{name}`" for name in rows)], lines)


def split(rows: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    """The unrelated pairs, and the related ones whose estimate is right."""
    return [r for r in rows if not r["true"]], [r for r in rows if r["true"] and r["nsgd"] < RIGHT]


def share(rows: Sequence[Row], holds: Callable[[Row], bool]) -> str:
    """The share of pairs for which something holds, in %, with its interval."""
    if not rows:
        return "–"
    i = share_interval(np.array([holds(row) for row in rows]), [f"{row['family']}/{row['scene']}" for row in rows])
    return f"{100 * i.value:.2f} [{100 * i.low:.2f}, {100 * i.high:.2f}]"


def percent(values: Sequence[bool]) -> str:
    """A share in %; a dash where there is nothing to take it of."""
    return f"{100 * np.mean(values):.2f}" if values else "–"


def area(right: Sequence[Row], unrelated: Sequence[Row], figure: Callable[[Row], float]) -> float:
    """The chance that a right pair has more of a figure than an unrelated one; ties count half."""
    a, b = np.array([figure(row) for row in right]), np.sort([figure(row) for row in unrelated])
    if len(a) == 0 or len(b) == 0:
        return math.nan
    return float((np.searchsorted(b, a, "left") + np.searchsorted(b, a, "right")).mean() / (2 * len(b)))


def table(heads: Sequence[str], lines: Sequence[Sequence[object]]) -> str:
    """A Markdown table, figures to the right."""
    rule = ["---", *["---:"] * (len(heads) - 1)]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in (heads, rule, *lines))


def significance(row: Row) -> float:
    """How far the support of a pair's F is beyond chance."""
    return float(row["significance"])


def _related(row: Row) -> bool:
    return significance(row) >= RELATED


def inliers(row: Row) -> int:
    """The number of inliers of a pair, 0 where there is no F."""
    return int(row["inliers"]) if row["ok"] else 0
