"""Tables of the stress test, from its rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fmtorch.evaluation.statistics import MERITS, PERCENT, areas, difference, unit
from scripts.benchmark.estimators_table import replaced
from scripts.benchmark.matched import console
from scripts.benchmark.sheet import MISSING, Sheet
from scripts.benchmark.stress_figure import AXES, draw
from scripts.benchmark.stress_rows import (
    GROUPS,
    Level,
    Row,
    at,
    count,
    figures,
    group,
    label,
    levels,
    methods,
    paired,
)


def seeds(rows: Sequence[Row]) -> str:
    """``3 seeds``, or ``3 seeds (poselib, truth: 1)`` where some estimators have fewer."""
    own = {row["method"]: len(row["nsgd"]) for row in rows}
    most = max(own.values())
    fewer: dict[int, list[str]] = {}
    for method, many in own.items():
        if many < most:
            fewer.setdefault(many, []).append(label(method))
    others = "; ".join(f"{', '.join(names)}: {count}" for count, names in sorted(fewer.items()))
    return f"{most} seed{'s' * (most != 1)}" + (f" ({others})" if others else "")


def write(page: Path, rows: Sequence[Row]) -> None:
    """The tables between the markers of a Markdown file, the figures beside it. SystemExit where it has no markers."""
    written = []
    for sweep in dict.fromkeys(row["sweep"] for row in rows):
        own = [row for row in rows if row["sweep"] == sweep]
        name = f"stress {sweep}"
        text = "\n\n".join(sheet.markdown() for sheet in sheets(own))
        if sweep in AXES:
            figure = page.with_name(f"{name.replace(' ', '_')}.svg")
            draw(own, sweep, figure)
            text = f"![AUC@0.05 by {sweep}]({figure.name})\n\n{text}"
        written.append(replaced(page, name, text))
    if not all(written):
        raise SystemExit(f"{page} lacks lines <!-- stress SWEEP --> and <!-- end stress SWEEP --> of a sweep")


def show(rows: Sequence[Row]) -> None:
    """All tables in the terminal."""
    for sweep in dict.fromkeys(row["sweep"] for row in rows):
        for sheet in sheets([row for row in rows if row["sweep"] == sweep]):
            console.print(sheet.terminal())


def sheets(rows: Sequence[Row]) -> list[Sheet]:
    """Of one sweep: figures and differences of each group, and times over all."""
    groups = []
    for name in GROUPS:
        own = [row for row in rows if group(row["family"]) == name]
        if own:
            groups += [recall_sheet(name, own), difference_sheet(name, own)]
    return [*groups, time_sheet(rows)]


def recall_sheet(name: str, rows: Sequence[Row]) -> Sheet:
    """Recall at NSGD 0.05 / at 0.01 / AUC@0.05: a row an estimator, a column a level."""
    lines = []
    for method in methods(rows):
        cells = []
        for level in levels(rows):
            nsgd = figures(rows, method, level)[0]
            cells.append(
                " / ".join(f"{PERCENT * of(nsgd).mean():.0f}" for of in MERITS.values()) if nsgd.size else MISSING
            )
        lines.append([label(method), *cells])
    kind = f"recall at NSGD 0.05 / at 0.01 / AUC@0.05, in %, {seeds(rows)}"
    title = f"{titled(rows, name)}: {kind}"
    heads = [f"{head(level)} ({count(rows, level)})" for level in levels(rows)]
    return Sheet(title, ["estimator (pairs in brackets)", *heads], lines)


def difference_sheet(name: str, rows: Sequence[Row]) -> Sheet:
    """AUC@0.05 of the first estimator minus that of each other, with intervals."""
    first, *others = methods(rows)
    lines, units = [], set()
    for method in others:
        cells = []
        for level in levels(rows):
            (own, scenes), (other, _) = paired(rows, first, method, level)
            units |= {unit(scenes)} if scenes else set()
            gain = difference(areas(own), areas(other), scenes, PERCENT) if scenes else None
            cells.append(MISSING if gain is None else f"{gain.value:+.0f} [{gain.low:+.0f}, {gain.high:+.0f}]")
        lines.append([label(method), *cells])
    over = " or ".join(f"{kind}s" for kind in sorted(units))
    title = f"{titled(rows, name)}: AUC@0.05 of {label(first)} minus this row, in points, 95 % intervals over {over}"
    return Sheet(title, ["estimator", *(head(level) for level in levels(rows))], lines)


def time_sheet(rows: Sequence[Row]) -> Sheet:
    """Median processor milliseconds a pair over all groups, and the median number of matches."""
    lines = [["matches", *(f"{np.median([r['matches'] for r in at(rows, level)]):.0f}" for level in levels(rows))]]
    for method in methods(rows):
        cells = [figures(rows, method, level)[1] for level in levels(rows)]
        lines.append([label(method), *(f"{np.median(ms):.1f}" if ms.size else MISSING for ms in cells)])
    title = f"{titled(rows, 'all')}: median number of matches, median processor milliseconds a pair"
    return Sheet(title, ["", *(head(level) for level in levels(rows))], lines)


def titled(rows: Sequence[Row], name: str) -> str:
    """The beginning of a table's title: sweep and group."""
    return f"{str(rows[0]['sweep']).capitalize()}; {name}"


def head(level: Level) -> str:
    return level if isinstance(level, str) else f"{level:g}"
