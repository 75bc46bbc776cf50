"""The tables of a report, as cells: figures of merit, families, paired differences, seconds."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fmtorch.evaluation.rows import CAPTION
from fmtorch.evaluation.statistics import FINE_THRESHOLD, LEVEL, POSE_THRESHOLDS, THRESHOLD
from fmtorch.evaluation.summary import ALL, STAGES
from fmtorch.evaluation.summary_tables import (
    CONFIGURATION_CAPTION,
    CONFIGURATION_COLUMNS,
    FOCAL_CAPTION,
    FOCAL_COLUMNS,
    HOMOGRAPHY_COLUMNS,
    MARKDOWN_COLUMNS,
    RECALL,
    Columns,
    known_columns,
    pose_caption,
    pose_columns,
)

DASH = "–"
Summaries = Mapping[str, Mapping[str, Any]]  # of `summarize`, by the runs' names


@dataclasses.dataclass(frozen=True)
class Bar:
    """What a cell draws below its figure, in percent of its width: an interval, its value, and a line at zero."""

    low: float
    value: float
    high: float
    zero: float | None = None


@dataclasses.dataclass(frozen=True)
class Cell:
    """A figure. best: the best of its column. shares: the parts, in percent, of a stacked bar."""

    text: str
    best: bool = False
    bar: Bar | None = None
    shares: Sequence[float] = ()


@dataclasses.dataclass(frozen=True)
class Table:
    """Cells by the runs' names, below their headings; the first heading is that of the names."""

    heading: str
    head: Sequence[str]
    rows: Mapping[str, Sequence[Cell]]
    note: str = ""
    stages: bool = False  # whether the headings are keys to the parts of stacked bars


def merit(summaries: Summaries) -> Table:
    """All figures over all pairs, a row a run."""
    counts = ("Pairs", "Scenes")  # which stand last: recall is what is looked for
    known = known_columns(MARKDOWN_COLUMNS, {name: summary[ALL] for name, summary in summaries.items()})
    columns = {heading: column for heading, column in known.items() if heading and heading not in counts}
    columns |= {heading: MARKDOWN_COLUMNS[heading] for heading in counts}
    ranked = {RECALL: "recall", f"at {FINE_THRESHOLD}": "recall_fine", "AUC@0.05": "auc_05"}
    best = {heading: _best({n: s[ALL][field] for n, s in summaries.items()}) for heading, field in ranked.items()}
    rows = {
        name: [
            Cell(
                column(summary[ALL]), name in best.get(heading, ()), _share(summary[ALL]) if heading == RECALL else None
            )
            for heading, column in columns.items()
        ]
        for name, summary in summaries.items()
    }
    return Table("Figures of merit", ["run", *columns], rows)


def poses(summaries: Summaries) -> Table | None:
    """Accuracy of relative poses over all pairs with known cameras; None where there are none."""
    known = {name: summary[ALL]["pose"] for name, summary in summaries.items() if summary[ALL]["pose"] is not None}
    if not known:
        return None
    columns = {heading: column for heading, column in pose_columns(list(known.items())).items() if heading}
    ranked = {f"AUC@{t}°": f"auc_{t}" for t in POSE_THRESHOLDS} | {"mAA(10°)": "maa_10"}
    best = {heading: _best({n: figures[field] for n, figures in known.items()}) for heading, field in ranked.items()}
    rows = {
        name: [
            Cell(column(known[name]), name in best.get(heading, ())) if name in known else Cell(DASH)
            for heading, column in columns.items()
        ]
        for name in summaries
    }
    return Table("Relative pose", ["run", *columns], rows, pose_caption(list(known.items()), binned=True))


def homographies(summaries: Summaries) -> Table | None:
    """Accuracy of homographies over all pairs; None where none is known."""
    return _of_field(summaries, "homography", "Homography", HOMOGRAPHY_COLUMNS, CAPTION)


def focals(summaries: Summaries) -> Table | None:
    """Accuracy of estimated focal lengths over all pairs; None where none were estimated."""
    return _of_field(summaries, "focals", "Focal lengths", FOCAL_COLUMNS, FOCAL_CAPTION)


def configurations(summaries: Summaries) -> Table | None:
    """How many pairs are in which configuration; None where nobody has looked."""
    return _of_field(summaries, "configurations", "Configurations", CONFIGURATION_COLUMNS, CONFIGURATION_CAPTION)


def _of_field(summaries: Summaries, field: str, heading: str, columns: Columns, note: str) -> Table | None:
    """The figures of a field over all pairs, a row a run."""
    known = {name: summary[ALL][field] for name, summary in summaries.items() if summary[ALL][field] is not None}
    if not known:
        return None
    shown = {name: column for name, column in columns.items() if name}
    rows = {
        name: [Cell(column(known[name])) if name in known else Cell(DASH) for column in shown.values()]
        for name in summaries
    }
    return Table(heading, ["run", *shown], rows, note)


def families(summaries: Summaries) -> Table | None:
    """Recall with its interval, and AUC@0.05, by family; None where there is but one."""
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


def seconds(summaries: Summaries) -> Table:
    """Median seconds a pair of each stage, and the commonest failures."""
    stages = [*STAGES, "total"]
    totals = {name: summary[ALL]["seconds"]["total"] or 0.0 for name, summary in summaries.items()}
    slowest = max(totals.values(), default=0.0)
    rows = {}
    for name, summary in summaries.items():
        known = summary[ALL]["seconds"]
        cells = [Cell(DASH if known[stage] is None else f"{known[stage]:.3f}") for stage in stages]
        stage_total = sum(known[stage] or 0.0 for stage in STAGES)
        width = 100 * totals[name] / slowest / stage_total if slowest and stage_total else 0.0
        rows[name] = [*cells[:-1], dataclasses.replace(cells[-1], shares=[width * (known[s] or 0.0) for s in STAGES])]
    failed = [
        f"{name}: {reason} ({count})"
        for name, summary in summaries.items()
        for reason, count in summary[ALL]["reasons"].items()
    ]
    note = ("Pairs that failed: " + "; ".join(failed) + ".") if failed else ""
    return Table("Seconds a pair, median", ["run", *stages], rows, note, stages=True)


def shared_keys(runs: Mapping[str, pa.Table]) -> list[int]:
    """The pairs that all runs hold, in the order of the first."""
    tables = list(runs.values())
    shared = set.intersection(*(set(table["key"].to_pylist()) for table in tables))
    return [key for key in tables[0]["key"].to_pylist() if key in shared]


def common(runs: Mapping[str, pa.Table], column: str) -> list[NDArray[np.float64]]:
    """A column of each run, of the pairs that all hold."""
    keys = shared_keys(runs)
    columns = []
    for table in runs.values():
        values = dict(zip(table["key"].to_pylist(), table[column].to_pylist(), strict=True))
        columns.append(np.array([values[key] for key in keys], np.float64))
    return columns


def _share(group: Mapping[str, Any]) -> Bar | None:
    if group["recall"] is None:
        return None
    low, high = group["recall_interval"]
    return Bar(100 * low, 100 * group["recall"], 100 * high)


def _best(values: Mapping[str, float | None]) -> set[str]:
    """Whose is the largest; nobody's of a single value."""
    known = [value for value in values.values() if value is not None]
    return {name for name, value in values.items() if value == max(known)} if len(known) > 1 else set()
