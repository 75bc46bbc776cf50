"""Summaries as tables: of one run on a terminal and in Markdown, of several runs as cells of a report."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table as TerminalTable

from fmtorch.core.types import PAIR_TYPES
from fmtorch.evaluation import curves, statistics
from fmtorch.evaluation.statistics import ALL, LEVEL, MIN_UNITS, STAGES, THRESHOLD, Group, Interval, Values

Columns = Mapping[str, Callable[[Group], str]]  # what stands below a heading, of the figures of a row
Summaries = Mapping[str, Mapping[str, Group]]  # of `summarize`, by the runs' names
DASH = "–"
RECALL = "%Recall [interval]"  # the column that has an interval
_OF_RECALL = ("%Recall", RECALL, f"at {statistics.FINE_THRESHOLD}", "AUC@0.05", "%Recall (released NSGD)")


def _text(value: float | int | None, form: str) -> str:
    return DASH if value is None else form.format(value)


def _number(field: str, form: str = "{}") -> Callable[[Group], str]:
    return lambda group: _text(group[field], form)


def _percent(field: str, form: str = "{:.1f}") -> Callable[[Group], str]:
    return lambda group: _text(None if group[field] is None else 100 * group[field], form)


def _recall(group: Group) -> str:
    if group["recall"] is None:
        return DASH
    low, high = group["recall_interval"]
    return f"{100 * group['recall']:.1f} [{100 * low:.0f}, {100 * high:.0f}]"


def _corrs(group: Group) -> str:
    return f"{_text(group['corrs'], '{:.0f}')} ({_text(group['corrs_before'], '{:.0f}')})"


LEAST_IMPORTANT = ("#Corrs (-m)", "%Inlier (-m)", "Failed")  # where a terminal has no room for all
TERMINAL_COLUMNS: Columns = {
    "Pairs": _number("pairs"),
    "%Recall": _recall,
    "AUC@0.05": _percent("auc_05"),
    "%Inlier (-m)": lambda group: f"{_percent('inlier_rate')(group)} ({_percent('inlier_rate_before')(group)})",
    "#Corrs (-m)": _corrs,
    "Failed": _number("failures"),
}
COLUMNS: Columns = {
    "Pairs": _number("pairs"),
    "Scenes": _number("scenes"),
    RECALL: _recall,
    f"at {statistics.FINE_THRESHOLD}": _percent("recall_fine"),
    "AUC@0.05": _percent("auc_05"),
    "%Recall (released NSGD)": _percent("recall_released"),
    "%Inlier": _percent("inlier_rate"),
    "with failures 0": _percent("inlier_rate_failures_0"),
    "%Inlier-m": _percent("inlier_rate_before"),
    "#Corrs (-m)": _corrs,
    "Failures": lambda group: f"{group['failures']} ({group['failure_share']:.1%})" if group["failures"] else "0",
}
INLIERS = (
    "%Inlier: right matches, within 3 px of the true homography, and #Corrs, after estimation, -m: before; means over "
    "the pairs that did not fail."
)


def known_columns(columns: Columns, groups: Mapping[str, Group]) -> Columns:
    """The columns without those of recall where no group has any: homographies have none."""
    if any(group["recall"] is not None or not group["pairs"] for group in groups.values()):
        return columns
    return {heading: column for heading, column in columns.items() if heading not in _OF_RECALL}


def caption(summary: Mapping[str, Group]) -> str:
    """What the columns mean, and what the intervals take for independent."""
    groups = _groups(summary)
    overs = dict.fromkeys(group["interval_over"] for group in groups.values() if group["interval_over"])
    where = {over: [name for name, g in groups.items() if g["interval_over"] == over] for over in overs}
    over = "; ".join(f"{o}s" + (f" ({', '.join(names)})" if len(where) > 1 else "") for o, names in where.items())
    if any(group["homography"] is not None for group in groups.values()):
        return INLIERS
    return (
        f"%Recall: NSGD < {THRESHOLD}, failures are misses; [{LEVEL:.0%} Wilson interval; independent units: "
        f"{over or 'pairs'}]. AUC@0.05: area under the recall curve to NSGD {THRESHOLD}. "
        "%Inlier, #Corrs: after estimation, -m: before; means over the pairs that did not fail."
    )


def _groups(summary: Mapping[str, Group]) -> dict[str, Group]:
    """The groups to show: ``all`` last, and not where it repeats the only family."""
    return {name: group for name, group in summary.items() if name != ALL or len(summary) != 2}


class Part(NamedTuple):
    """A table of what some groups have beside their recall. ranked: the fields of columns whose largest is the best."""

    heading: str
    note: str
    columns: Columns
    rows: Mapping[str, Group]
    ranked: Mapping[str, str] = {}


POSE = {  # what is said of poses, by whether the sign of a translation counts
    False: "Of the pairs with known cameras, by the larger of the angles of rotation and of translation, which is "
    "folded: its sign does not count. Failures count as 180° and 90°. AUC: area under the recall curve; mAA(10°): mean "
    "of recall at 1°, ..., 10°; R error, t error: medians.",
    True: "Of the pairs with known cameras, by the larger of the angles of rotation and of translation, whose sign "
    "counts (pose.signed=true); of an F without cameras, of the best of its four poses, as PoseBench. Failures count "
    "as 180°. AUC: area under the recall curve; mAA(10°): mean of recall at 1°, ..., 10°; R error, t error: medians.",
}
BINNED = " mAP: mean of recall at 5°, 10°, ..., as in papers before 2020."
PROTOCOL = (
    "As learned pruners are published; failures are misses. mAP: mean of recall at 5°, 10°, ..., beside mAP5° and "
    "mAP20° of OANet (ICCV 2019) and NCMNet (CVPR 2023), whose code calls them acc_qt_auc. AUC: the exact area, beside "
    "AUC@5°, 10°, 20° of SuperGlue and ConvMatch (AAAI 2023). P, R, F: the estimator's inliers against geodesic "
    "distances below 1e-4, beside precision, recall and F-score of OANet and ConvMatch. weighted_eight_point stands "
    "beside rows without RANSAC, opencv_essential beside those with it; both need cameras=known."
)
PROTOCOL_COLUMNS: Columns = {
    **{f"mAP@{t}°": _percent(f"map_{t}") for t in (5, 20)},
    **{f"AUC@{t}°": _percent(f"auc_{t}") for t in statistics.POSE_THRESHOLDS},
    **{heading: _percent(field) for heading, field in (("P", "precision"), ("R", "recall"), ("F", "f_score"))},
}
HOMOGRAPHY = (
    "By the mean distance, in image 1, between the corners of image 0 as the true and the estimated homography map "
    "them; failures are misses. AUC: area under the recall curve; corner error: median."
)
HOMOGRAPHY_COLUMNS: Columns = {
    "Pairs": _number("pairs"),
    **{f"AUC@{t} px": _percent(f"auc_{t}px") for t in statistics.CORNER_THRESHOLDS},
    "corner error": _number("corner_error", "{:.2f} px"),
}
FOCALS = (
    "Of the estimated focal lengths of known cameras: median relative error, median ratio, and shares within an error; "
    "those of failed pairs, and those that are not determined, are misses."
)
FOCAL_COLUMNS: Columns = {
    "Images": _number("images"),
    "error": _percent("error", "{:.1f} %"),
    "f / true f": _number("ratio", "{:.3f}"),
    **{f"%within {p} %": _percent(f"within_{p}") for p in statistics.FOCAL_THRESHOLDS},
}
KINDS = (
    "Number of pairs by what their matches show, beginning from the estimate of each run: another estimator may see "
    "another plane. Those of one plane, of a camera that only turns, or of one photograph twice do not determine F: "
    "recall of such pairs is luck."
)


def parts(groups: Mapping[str, Group], binned: bool = True) -> list[Part]:
    """Poses, homographies, focal lengths and pair types, of the groups that have some. binned: with mAP."""

    def known(field: str) -> dict[str, Group]:
        return {name: group[field] for name, group in groups.items() if group[field] is not None}

    pruned = {name: groups[name]["pose"] | labels for name, labels in known("labels").items()}
    tables = [
        _poses(known("pose"), binned),
        Part("Pruning", PROTOCOL, PROTOCOL_COLUMNS, pruned),
        Part("Homography", HOMOGRAPHY, HOMOGRAPHY_COLUMNS, known("homography")),
        Part("Focal lengths", FOCALS, FOCAL_COLUMNS, known("focals")),
        Part("Pair types", KINDS, {name: _number(name) for name in PAIR_TYPES}, known("pair_types")),
    ]
    return [table for table in tables if table.rows]


def _poses(rows: Mapping[str, Group], binned: bool) -> Part:
    """Its last heading says whether translations are folded or signed, where all are alike; else the note, by rows."""
    by_sign = {signed: [name for name, row in rows.items() if row["signed"] == signed] for signed in (False, True)}
    said = [(signed, names) for signed, names in by_sign.items() if names]
    suffix = "" if len(said) != 1 else ", signed" if said[0][0] else ", folded"
    note = " ".join(POSE[signed] if len(said) == 1 else f"{', '.join(names)}: {POSE[signed]}" for signed, names in said)
    of_area = {f"AUC@{t}°": f"auc_{t}" for t in statistics.POSE_THRESHOLDS} | {"mAA(10°)": "maa_10"}
    columns: Columns = {
        "Pairs": _number("pairs"),
        **{heading: _percent(field) for heading, field in of_area.items()},
        **{f"mAP@{t}°": _percent(f"map_{t}") for t in statistics.POSE_THRESHOLDS if binned},
        "R error": _number("rotation", "{:.2f}°"),
        f"t error{suffix}": _number("translation", "{:.2f}°"),
    }
    return Part("Relative pose", note + BINNED * binned, columns, rows, of_area)


def _parts_of_run(summary: Mapping[str, Group], binned: bool) -> list[Part]:
    """Pair types only where a pair is not general."""
    kinds = [group["pair_types"] or {} for group in summary.values()]
    general = not any(count for counts in kinds for kind, count in counts.items() if kind != "general")
    return [part for part in parts(_groups(summary), binned) if part.heading != "Pair types" or not general]


def terminal_tables(summary: Mapping[str, Group], title: str, width: int = 80) -> list[TerminalTable]:
    """The main figures of a run, or of several by their names, for a terminal of so many columns.
    Columns for which there is no room are left out, and the note says so, rather than words and numbers broken."""
    first = Part(title, caption(summary), known_columns(TERMINAL_COLUMNS, summary), _groups(summary))
    return [_fitted(part, width) for part in (first, *_parts_of_run(summary, binned=False))]


def _fitted(part: Part, width: int) -> TerminalTable:
    """The table with as many columns as there is room for: the least important go first, else the last."""
    wide, columns = Console(width=1000), dict(part.columns)
    while True:
        dropped = [heading for heading in part.columns if heading not in columns]
        note = f"{part.note} No room for {', '.join(dropped)}: summary.md has all." if dropped else part.note
        table = _on_terminal(part._replace(columns=columns, note=note))
        bare = _on_terminal(part._replace(columns=columns, note="", heading=""))
        if len(columns) < 3 or Measurement.get(wide, wide.options, bare).minimum <= width:
            return table
        columns.pop(next((heading for heading in LEAST_IMPORTANT if heading in columns), list(columns)[-1]))


def _on_terminal(part: Part) -> TerminalTable:
    table = TerminalTable(
        title=part.heading, title_style="bold", caption=part.note, caption_justify="left", caption_style="dim",
        box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True,
    )  # fmt: skip
    words = [word for name in part.rows for word in name.split()]
    table.add_column("", overflow="fold", min_width=max(map(len, words), default=1))
    rows = {name: _cells(part, group) for name, group in part.rows.items()}
    for heading, *cells in zip(part.columns, *rows.values(), strict=True):
        table.add_column(heading, justify="right", no_wrap=True, min_width=max(map(len, (heading, *cells))))
    for name, row in rows.items():
        table.add_row(name, *row, style="bold" if name == ALL else "")
    return table


def summary_markdown(summary: Mapping[str, Group], title: str) -> str:
    """All figures of a run as a Markdown page."""
    groups = _groups(summary)
    seconds = {stage: _number(stage, "{:.3f}") for stage in (*STAGES, "total")}
    first = Part("", caption(summary), known_columns(COLUMNS, summary), groups)
    last = Part("seconds (median per pair)", "", seconds, {name: group["seconds"] for name, group in groups.items()})
    failures = [
        f"- {name}: {_escape(reason)} ({count})"
        for name, group in groups.items()
        if name != ALL or len(summary) == 1
        for reason, count in group["reasons"].items()
    ]
    if failures:
        failures = ["Commonest reasons of failure, with the number of pairs:", "\n".join(failures)]
    tables = [text for part in (first, *_parts_of_run(summary, binned=True), last) for text in _in_markdown(part)]
    return "\n\n".join([f"# {title}", *tables, *failures]) + "\n"


def _in_markdown(part: Part) -> list[str]:
    rows = [[part.heading, *part.columns], ["---", *["---:"] * len(part.columns)]]
    rows += [[name, *_cells(part, group)] for name, group in part.rows.items()]
    table = "\n".join("| " + " | ".join(_escape(cell) for cell in row) + " |" for row in rows)
    return [table, part.note] if part.note else [table]


def _cells(part: Part, group: Group) -> list[str]:
    return [column(group) for column in part.columns.values()]


def _escape(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


class Bar(NamedTuple):
    """What a cell draws below its figure, in percent of its width: an interval, its value, and a line at zero."""

    low: float
    value: float
    high: float
    zero: float | None = None


class Cell(NamedTuple):
    """A figure. best: the best of its column. shares: the parts, in percent, of a stacked bar."""

    text: str
    best: bool = False
    bar: Bar | None = None
    shares: Sequence[float] = ()


class Table(NamedTuple):
    """Cells by the runs' names, below their headings; the first heading is that of the names."""

    heading: str
    head: Sequence[str]
    rows: Mapping[str, list[Cell]]
    note: str = ""
    stages: bool = False  # whether the headings are keys to the parts of stacked bars


def report_tables(runs: Mapping[str, pa.Table], summaries: Summaries) -> list[Table]:
    """The tables of runs on one data set, a row a run."""
    overall = {name: summary[ALL] for name, summary in summaries.items()}
    compared = (_families(summaries), *(_of_runs(part, summaries) for part in parts(overall)), _differences(runs))
    return [_merit(overall), *(table for table in compared if table), _seconds(overall)]


def _merit(overall: Mapping[str, Group]) -> Table:
    known = known_columns(COLUMNS, overall)
    counts = ("Pairs", "Scenes")
    columns = {h: c for h, c in known.items() if h not in counts} | {h: COLUMNS[h] for h in counts}
    ranked = {RECALL: "recall", f"at {statistics.FINE_THRESHOLD}": "recall_fine", "AUC@0.05": "auc_05"}
    table = _of_runs(Part("Figures of merit", "", columns, overall, ranked), overall)
    if RECALL not in columns:
        return table
    place = list(columns).index(RECALL)
    for name, cells in table.rows.items():
        cells[place] = cells[place]._replace(bar=_share(overall[name]))
    return table


def _of_runs(part: Part, names: Iterable[str]) -> Table:
    """Dashes stand where a run has none of it."""
    best = {h: _best({name: row[field] for name, row in part.rows.items()}) for h, field in part.ranked.items()}
    rows = {
        name: [
            Cell(column(part.rows[name]), name in best.get(heading, ())) if name in part.rows else Cell(DASH)
            for heading, column in part.columns.items()
        ]
        for name in names
    }
    return Table(part.heading, ["run", *part.columns], rows, part.note)


def _families(summaries: Summaries) -> Table | None:
    names = list(dict.fromkeys(family for summary in summaries.values() for family in summary if family != ALL))
    if len(names) < 2 or any(group["recall"] is None for summary in summaries.values() for group in summary.values()):
        return None
    best = {f: _best({n: s[f]["auc_05"] for n, s in summaries.items() if f in s}) for f in names}
    rows = {
        name: [
            Cell(f"{100 * group['recall']:.1f} / {100 * group['auc_05']:.1f}", name in best[family], _share(group))
            if (group := summary.get(family))
            else Cell(DASH)
            for family in names
        ]
        for name, summary in summaries.items()
    }
    note = f"Bars: the {LEVEL:.0%} Wilson interval of recall, from 0 to 100 %. Bold: the largest AUC@0.05."
    return Table(f"By family: %Recall at {THRESHOLD} / AUC@0.05", ["run", *names], rows, note)


def _differences(runs: Mapping[str, pa.Table]) -> Table | None:
    if len(runs) < 2:
        return None
    axis = curves.axis_of(runs)
    first, *others = runs
    keys, families, scenes = (runs[first][name].to_pylist() for name in ("key", "family", "scene"))
    scene = dict(zip(keys, statistics.scene_names(families, scenes), strict=True))
    counts, compared = [], []
    for other in others:
        two = {first: runs[first], other: runs[other]}
        a, b = common(two, axis.column)
        counts.append(len(a))
        compared.append(_paired_differences(a, b, [scene[key] for key in shared_keys(two)], axis is curves.NSGD))
    ends = [abs(end) for cells in compared for _, i in cells if i for end in (i.low, i.high)]
    widest = max(ends, default=1.0) or 1.0
    rows = {
        name: [Cell(f"{count:,}"), *(Cell(text, bar=_around_zero(i, widest)) for text, i in cells)]
        for name, count, cells in zip(others, counts, compared, strict=True)
    }
    of_nsgd = [f"recall at {THRESHOLD}", f"at {statistics.FINE_THRESHOLD}", "AUC@0.05"]
    figures = of_nsgd if axis is curves.NSGD else [f"AUC@{t} px" for t in statistics.CORNER_THRESHOLDS]
    head = ["run", "shared pairs", *figures]
    note = (
        f"In points; positive where {first} is ahead of the row's run. In brackets the paired {LEVEL:.0%} interval "
        f"(Bonett and Price's for recall, a bootstrap for AUC@0.05 from {MIN_UNITS} scenes or pairs on): a difference "
        "whose interval holds 0 may be chance."
    )
    return Table(f"{first} minus each other run, pair by pair", head, rows, note)


def _paired_differences(
    a: Values, b: Values, scenes: Sequence[str], of_nsgd: bool
) -> list[tuple[str, Interval | None]]:
    """Differences of recall at both thresholds and of AUC@0.05, or of areas below corner errors, of the same pairs."""
    if of_nsgd:
        limits = THRESHOLD, statistics.FINE_THRESHOLD
        values = [(statistics.recalled(a, t), statistics.recalled(b, t), True) for t in limits]
        values.append((statistics.areas(a), statistics.areas(b), False))
    else:
        values = [(statistics.areas(a, t), statistics.areas(b, t), False) for t in statistics.CORNER_THRESHOLDS]
    cells: list[tuple[str, Interval | None]] = []
    for own, other, share in values:
        interval = statistics.difference(own, other, scenes, statistics.PERCENT, share=share) if len(a) else None
        few = f"{statistics.PERCENT * float((own - other).mean()):+.1f} (n too small)" if len(a) else DASH
        cells.append((few if interval is None else f"{interval:+.1f}", interval))
    return cells


def _around_zero(i: Interval | None, widest: float) -> Bar | None:
    if i is None:
        return None
    low, value, high = (50 + 50 * end / widest for end in (i.low, i.value, i.high))
    return Bar(low, value, high, zero=50.0)


def _seconds(overall: Mapping[str, Group]) -> Table:
    columns = {stage: _number(stage, "{:.3f}") for stage in (*STAGES, "total")}
    known = {name: group["seconds"] for name, group in overall.items()}
    table = _of_runs(Part("Seconds a pair, median", "", columns, known), overall)
    slowest = max((seconds["total"] or 0.0 for seconds in known.values()), default=0.0)
    for name, seconds in known.items():
        stages = [seconds[stage] or 0.0 for stage in STAGES]
        width = 100 * (seconds["total"] or 0.0) / slowest / sum(stages) if slowest and sum(stages) else 0.0
        table.rows[name][-1] = table.rows[name][-1]._replace(shares=[width * each for each in stages])
    failed = [f"{name}: {reason} ({n})" for name, group in overall.items() for reason, n in group["reasons"].items()]
    return table._replace(note=f"Pairs that failed: {'; '.join(failed)}." if failed else "", stages=True)


def shared_keys(runs: Mapping[str, pa.Table]) -> list[int]:
    """The pairs that all runs hold, in the order of the first."""
    tables = list(runs.values())
    shared = set.intersection(*(set(table["key"].to_pylist()) for table in tables))
    return [key for key in tables[0]["key"].to_pylist() if key in shared]


def common(runs: Mapping[str, pa.Table], column: str) -> list[Values]:
    """A column of each run, of the pairs that all hold."""
    keys = shared_keys(runs)
    columns = []
    for table in runs.values():
        values = dict(zip(table["key"].to_pylist(), table[column].to_pylist(), strict=True))
        columns.append(np.array([values[key] for key in keys], np.float64))
    return columns


def _share(group: Group) -> Bar | None:
    if group["recall"] is None:
        return None
    low, high = group["recall_interval"]
    return Bar(100 * low, 100 * group["recall"], 100 * high)


def _best(values: Mapping[str, float | None]) -> set[str]:
    known = [value for value in values.values() if value is not None]
    return {name for name, value in values.items() if value == max(known)} if len(known) > 1 else set()
