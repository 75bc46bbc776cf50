"""The summary of a run as tables: for a terminal, and as a Markdown page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich import box
from rich.table import Table

from fmtorch.core.types import CONFIGURATIONS
from fmtorch.evaluation.rows import CAPTION, INLIERS, THRESHOLDS
from fmtorch.evaluation.statistics import FINE_THRESHOLD, FOCAL_THRESHOLDS, LEVEL, POSE_THRESHOLDS, THRESHOLD
from fmtorch.evaluation.summary import ALL, STAGES, Group

RECALL = "%Recall [interval]"  # the column that has an interval
_DASH = "–"
_OF_RECALL = ("%Recall", RECALL, f"at {FINE_THRESHOLD}", "AUC@0.05", "%Recall (released NSGD)")
Columns = Mapping[str, Callable[[Group], str]]
PoseRows = Sequence[tuple[str, Mapping[str, Any]]]  # names, and figures of `pose_figures`


def summary_table(summary: Mapping[str, Group], title: str) -> Table:
    """The main figures, for a terminal of 80 columns."""
    return _shown(title, caption(summary), known_columns(_TERMINAL, summary), _rows(summary))


def known_columns(columns: Columns, summary: Mapping[str, Group]) -> Columns:
    """The columns without those of recall where no group has any: homographies have none."""
    if any(group["recall"] is not None or not group["pairs"] for group in summary.values()):
        return columns
    return {heading: column for heading, column in columns.items() if heading not in _OF_RECALL}


def pose_table(summary: Mapping[str, Group]) -> Table | None:
    """The figures of poses, for a terminal of 80 columns; None where no pair has known cameras."""
    rows = _pose_rows(summary)
    columns = {heading: column for heading, column in pose_columns(rows).items() if "mAP" not in heading}
    return _shown("Relative pose", pose_caption(rows), columns, rows) if rows else None


def further_tables(summary: Mapping[str, Group]) -> list[Table]:
    """Homographies and focal lengths where some were estimated, and configurations where a pair is not general."""
    return [_shown(heading, note, columns, rows) for heading, note, columns, rows in _further(summary)]


def _further(summary: Mapping[str, Group]) -> list[tuple[str, str, Columns, list[tuple[str, Group]]]]:
    focals = [(name, group["focals"]) for name, group in _rows(summary) if group["focals"] is not None]
    kinds = [(name, group["configurations"]) for name, group in _rows(summary) if group["configurations"] is not None]
    planes = [(name, group["homography"]) for name, group in _rows(summary) if group["homography"] is not None]
    tables = [("Homography", CAPTION, HOMOGRAPHY_COLUMNS, planes)] if planes else []
    tables += [("Focal lengths", FOCAL_CAPTION, FOCAL_COLUMNS, focals)] if focals else []
    if any(count for _, group in kinds for name, count in group.items() if name != "general"):
        tables.append(("Configurations", CONFIGURATION_CAPTION, CONFIGURATION_COLUMNS, kinds))
    return tables


def _shown(title: str, caption: str, columns: Columns, rows: list[tuple[str, Group]]) -> Table:
    shown = Table(
        title=title, title_style="bold", caption=caption, caption_justify="left", caption_style="dim",
        box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True,
    )  # fmt: skip
    for i, heading in enumerate(columns):
        shown.add_column(heading, justify="right" if i else "left", no_wrap=i > 0, overflow="fold")
    for name, group in rows:
        shown.add_row(*_cells(columns, name, group), style="bold" if name == ALL else "")
    return shown


def summary_markdown(summary: Mapping[str, Group], title: str) -> str:
    """All figures as a Markdown page."""
    shown = known_columns(MARKDOWN_COLUMNS, summary)
    rows = [list(shown), ["---", *["---:"] * (len(shown) - 1)]]
    rows += [_cells(shown, name, group) for name, group in _rows(summary)]
    stages = [["seconds (median per pair)", *STAGES, "total"], ["---", *["---:"] * (len(STAGES) + 1)]]
    for name, group in _rows(summary):
        stages.append([name, *(_number(group["seconds"][stage], "{:.3f}") for stage in (*STAGES, "total"))])
    failures = [
        f"- {name}: {_escape(reason)} ({count})"
        for name, group in _rows(summary)
        if name != ALL or len(summary) == 1
        for reason, count in group["reasons"].items()
    ]
    parts = [f"# {title}", _lines(rows), caption(summary)]
    if poses := _pose_rows(summary):
        columns = pose_columns(poses)
        head = [["Relative pose", *list(columns)[1:]], ["---", *["---:"] * (len(columns) - 1)]]
        parts += [
            _lines([*head, *(_cells(columns, name, group) for name, group in poses)]),
            pose_caption(poses, binned=True),
        ]
    for heading, note, columns, groups in _further(summary):
        head = [[heading, *list(columns)[1:]], ["---", *["---:"] * (len(columns) - 1)]]
        parts += [_lines([*head, *(_cells(columns, name, group) for name, group in groups)]), note]
    parts.append(_lines(stages))
    if failures:
        parts += ["Commonest reasons of failure, with the number of pairs:", "\n".join(failures)]
    return "\n\n".join(parts) + "\n"


def _rows(summary: Mapping[str, Group]) -> list[tuple[str, Group]]:
    """The groups to show: ``all`` last, and not where it repeats the only family."""
    return [(name, group) for name, group in summary.items() if name != ALL or len(summary) != 2]


def _pose_rows(summary: Mapping[str, Group]) -> list[tuple[str, Group]]:
    """The figures of poses of the groups to show that have some."""
    return [(name, group["pose"]) for name, group in _rows(summary) if group["pose"] is not None]


def _cells(columns: Columns, name: str, group: Group) -> list[str]:
    return [name, *(column(group) for heading, column in columns.items() if heading)]


def caption(summary: Mapping[str, Group]) -> str:
    """What the columns mean, and what the intervals take for independent."""
    overs = dict.fromkeys(group["interval_over"] for _, group in _rows(summary) if group["interval_over"])
    where = {over: [name for name, g in _rows(summary) if g["interval_over"] == over] for over in overs}
    over = "; ".join(f"{o}s" + (f" ({', '.join(names)})" if len(where) > 1 else "") for o, names in where.items())
    if any(group["homography"] is not None for _, group in _rows(summary)):
        return INLIERS
    return (
        f"%Recall: NSGD < {THRESHOLD}, failures are misses; [{LEVEL:.0%} Wilson interval; independent units: "
        f"{over or 'pairs'}]. AUC@0.05: area under the recall curve to NSGD {THRESHOLD}. "
        "%Inlier, #Corrs: after estimation, -m: before; means over the pairs that did not fail."
    )


def _lines(rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(_escape(cell) for cell in row) + " |" for row in rows)


def _escape(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def _number(value: float | int | None, form: str) -> str:
    return _DASH if value is None else form.format(value)


def _percent(field: str) -> Callable[[Group], str]:
    return lambda group: _number(None if group[field] is None else 100 * group[field], "{:.1f}")


def _recall(group: Group) -> str:
    if group["recall"] is None:
        return _DASH
    low, high = group["recall_interval"]
    return f"{100 * group['recall']:.1f} [{100 * low:.0f}, {100 * high:.0f}]"


def _corrs(group: Group) -> str:
    return f"{_number(group['corrs'], '{:.0f}')} ({_number(group['corrs_before'], '{:.0f}')})"


def _failures(group: Group) -> str:
    return f"{group['failures']} ({_number(group['failure_share'], '{:.1%}')})" if group["failures"] else "0"


_TERMINAL: Columns = {
    "": lambda group: "",
    "Pairs": lambda group: str(group["pairs"]),
    "%Recall": _recall,
    "AUC@0.05": _percent("auc_05"),
    "%Inlier (-m)": lambda group: f"{_percent('inlier_rate')(group)} ({_percent('inlier_rate_before')(group)})",
    "#Corrs (-m)": _corrs,
    "Failed": lambda group: str(group["failures"]),
}
MARKDOWN_COLUMNS: Columns = {
    "": lambda group: "",
    "Pairs": lambda group: str(group["pairs"]),
    "Scenes": lambda group: str(group["scenes"]),
    RECALL: _recall,
    f"at {FINE_THRESHOLD}": _percent("recall_fine"),
    "AUC@0.05": _percent("auc_05"),
    "%Recall (released NSGD)": _percent("recall_released"),
    "%Inlier": _percent("inlier_rate"),
    "with failures 0": _percent("inlier_rate_failures_0"),
    "%Inlier-m": _percent("inlier_rate_before"),
    "#Corrs (-m)": _corrs,
    "Failures": _failures,
}


POSE_COLUMNS: Columns = {
    "": lambda group: "",
    "Pairs": lambda group: str(group["pairs"]),
    **{f"AUC@{t}°": _percent(f"auc_{t}") for t in POSE_THRESHOLDS},
    "mAA(10°)": _percent("maa_10"),
    **{f"mAP@{t}°": _percent(f"map_{t}") for t in POSE_THRESHOLDS},
    "R error": lambda group: f"{group['rotation']:.2f}°",
    "t error": lambda group: f"{group['translation']:.2f}°",
}
POSE_CAPTION = (
    "Of the pairs with known cameras, by the larger of the angles of rotation and of translation, which is folded: its "
    "sign does not count. Failures count as 180° and 90°. AUC: area under the recall curve; mAA(10°): mean of recall "
    "at 1°, ..., 10°; R error, t error: medians."
)
SIGNED_POSE_CAPTION = (
    "Of the pairs with known cameras, by the larger of the angles of rotation and of translation, whose sign counts "
    "(pose.signed=true); of an F without cameras, of the best of its four poses, as PoseBench. Failures count as 180°. "
    "AUC: area under the recall curve; mAA(10°): mean of recall at 1°, ..., 10°; R error, t error: medians."
)
BINNED = "mAP: mean of recall at 5°, 10°, ..., as in papers before 2020."


def pose_columns(rows: PoseRows) -> Columns:
    """The columns of poses; the last one says whether translations are folded or signed, where all are alike."""
    signs = {group.get("signed", False) for _, group in rows}
    suffix = {False: ", folded", True: ", signed"}[signs.pop()] if len(signs) == 1 else ""
    return {f"{heading}{suffix * (heading == 't error')}": column for heading, column in POSE_COLUMNS.items()}


def pose_caption(rows: PoseRows, binned: bool = False) -> str:
    """What the columns of poses mean, for rows of one kind or, with their names, of both; binned: mAP is among them."""
    names = {signed: [name for name, group in rows if group.get("signed", False) == signed] for signed in (False, True)}
    captions = {False: POSE_CAPTION, True: SIGNED_POSE_CAPTION}
    said = [(captions[signed], ", ".join(each)) for signed, each in names.items() if each]
    text = " ".join(caption if len(said) == 1 else f"{which}: {caption}" for caption, which in said)
    return f"{text} {BINNED}" if binned else text


HOMOGRAPHY_COLUMNS: Columns = {
    "": lambda group: "",
    "Pairs": lambda group: str(group["pairs"]),
    **{f"AUC@{t} px": _percent(f"auc_{t}px") for t in THRESHOLDS},
    "corner error": lambda group: _number(group["corner_error"], "{:.2f} px"),
}
FOCAL_COLUMNS: Columns = {
    "": lambda group: "",
    "Images": lambda group: str(group["images"]),
    "error": lambda group: _number(None if group["error"] is None else 100 * group["error"], "{:.1f} %"),
    "f / true f": lambda group: _number(group["ratio"], "{:.3f}"),
    **{f"%within {p} %": _percent(f"within_{p}") for p in FOCAL_THRESHOLDS},
}
FOCAL_CAPTION = (
    "Of the estimated focal lengths of known cameras: median relative error, median ratio, and shares within an error; "
    "those of failed pairs, and those that are not determined, are misses."
)
CONFIGURATION_COLUMNS: Columns = {
    "": lambda group: "",
    **{name: (lambda group, name=name: str(group[name])) for name in CONFIGURATIONS},  # type: ignore[misc]
}
CONFIGURATION_CAPTION = (
    "Number of pairs by what their matches show. Those of one plane, of a camera that only turns, or of one photograph "
    "twice do not determine F: recall of such pairs is luck."
)
