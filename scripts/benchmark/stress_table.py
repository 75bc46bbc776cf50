"""Tables and figures of the stress test, from its rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.baselines import WIDE
from fmtorch.data.rendered.generate import FAMILIES
from fmtorch.evaluation.statistics import MERITS, PERCENT, areas, difference, scene_names, unit
from fmtorch.storage import replacing
from scripts.benchmark.estimators_table import replaced
from scripts.benchmark.matched import console
from scripts.benchmark.sheet import MISSING, Sheet
from scripts.benchmark.stress_changes import CONDITIONS

Row = dict[str, Any]
Level = float | str
GROUPS = ("real, wide", "real, short", "rendered")
AXES = {"inlier ratio": "inlier ratio", "noise": "added noise [px]", "match count": "matches"}
LOGARITHMIC = ("inlier ratio", "match count")
PLANE, TURN = 0.8, 0.02
INK = "#808080"  # legible on white and on black
COLOURS = ("#D55E00", "#E69F00", "#009E73", "#56B4E9", "#2F8FD0", "#CC79A7", "#9A9A9A", "#B8A800")
DASHES = ("-", "-", "--", "--", "-.", "-.", ":", ":")


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
    whole = [cell for (sweep, *_), cell in by_cell.items() if cell.keys() >= wanted[sweep]]
    seeds = {name: min((len(cell[name]["nsgd"]) for cell in whole if name in cell), default=0) for name in names}
    return [
        cell[name] | {figure: cell[name][figure][: seeds[name]] for figure in ("nsgd", "ms")}
        for name in names for cell in whole if name in cell
    ]  # fmt: skip


def seeds(rows: Sequence[Row]) -> str:
    """``3 seeds``, or ``3 seeds (poselib, truth: 1)`` where some estimators have fewer."""
    own = {row["method"]: len(row["nsgd"]) for row in rows}
    most = max(own.values())
    fewer: dict[int, list[str]] = {}
    for method, count in own.items():
        if count < most:
            fewer.setdefault(count, []).append(label(method))
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
    found = []
    for name in GROUPS:
        own = [row for row in rows if group(row["family"]) == name]
        if own:
            found += [recall_sheet(name, own), difference_sheet(name, own)]
    return [*found, time_sheet(rows)]


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
    over = " or ".join(f"{one}s" for one in sorted(units))
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


def draw(rows: Sequence[Row], sweep: str, path: Path) -> None:
    """AUC@0.05 against the level, a panel for each group; an SVG without background, for light and dark pages."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    names = [name for name in GROUPS if any(group(row["family"]) == name for row in rows)]
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": sweep, "font.size": 9, "font.family": "sans-serif"}):
        figure = Figure(figsize=(3.1 * len(names) + 0.3, 3.4), layout="constrained")
        panels: Any = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
        for panel, name in zip(panels, names, strict=True):
            own = [row for row in rows if group(row["family"]) == name]
            for i, method in enumerate(methods(own)):
                points = [(x, figures(own, method, x)[0]) for x in levels(own)]
                drawn = [(float(x), PERCENT * float(areas(nsgd).mean())) for x, nsgd in points if nsgd.size]
                panel.plot(
                    *zip(*drawn, strict=True), DASHES[i % len(DASHES)], color=COLOURS[i % len(COLOURS)],
                    linewidth=2.4 if i == 0 else 1.4, label=label(method), zorder=3 - i / 100,
                )  # fmt: skip
            panel.set_title(name, loc="left", fontsize=9, color=INK)
            panel.set(xlabel=AXES[sweep], xscale="log" if sweep in LOGARITHMIC else "linear")
            ticks = [float(x) for x in levels(own)]
            panel.set_xticks(ticks, [f"{x:g}" for x in ticks])
            panel.minorticks_off()
            panel.tick_params(colors=INK, length=2)
            panel.xaxis.label.set_color(INK)
            panel.grid(color=INK, alpha=0.25, linewidth=0.5)
            for spine in panel.spines.values():
                spine.set_visible(False)
        panels[0].set_ylabel("AUC@0.05 [%]", color=INK)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, labelcolor=INK, fontsize=8)
        with replacing(path) as temporary:
            figure.savefig(temporary, format="svg", transparent=True, metadata={"Date": None})


def label(method: str) -> str:
    """An estimator's name in tables: without its stages and the options that all of its kind have."""
    front, _, stages = method.partition("@")
    name, _, rest = front.partition(":")
    telling = [
        option for option in rest.split(",") if option and option.partition("=")[0] not in ("threshold", "prosac")
    ]
    return ", ".join([name, *telling, *(["no sizes"] if "sizeless" in stages else [])])


def titled(rows: Sequence[Row], name: str) -> str:
    """The beginning of a table's title: sweep and group."""
    return f"{str(rows[0]['sweep']).capitalize()}; {name}"


def head(level: Level) -> str:
    return level if isinstance(level, str) else f"{level:g}"


def methods(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["method"] for row in rows))


def levels(rows: Sequence[Row]) -> list[Level]:
    """In the order of the sweep; after conditions, which of the unchanged pairs show a plane or little translation."""
    found = list(dict.fromkeys(row["level"] for row in rows))
    if all(isinstance(level, float) for level in found):
        return sorted(found)
    ordered = [name for name in CONDITIONS if name in found]
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
    found = []
    for method in (first, second):
        own = [by_method[method][pair] for pair in both]
        scenes = scene_names([row["family"] for row in own], [row["scene"] for row in own])
        found.append((np.array([row["nsgd"] for row in own]).T, scenes))
    return found[0], found[1]
