"""Tables of estimators' figures, in the terminal and in Markdown files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from matched import console, groups
from rich.table import Table

from fmtorch.data import ImagePair

COLUMNS = ("R.05", "R.01", "AUC@0.05", "first minus this: R.01", "AUC@0.05", "ms median", "ms mean", "ratio")


def ahead(figures: dict[str, Any]) -> list[str]:
    """The differences in recall at 0.01 and in AUC@0.05, with their intervals; empty for the first itself."""
    return [
        "" if figures[key] == (0.0, 0.0, 0.0) else "{:+.1f} [{:+.1f}, {:+.1f}]".format(*figures[key])
        for key in ("ahead_recall_01", "ahead_auc_05")
    ]


def cells(figures: dict[str, Any]) -> list[str]:
    """One estimator's row of COLUMNS."""
    recalls = [f"{figures[key]:.1f}" for key in ("recall_05", "recall_01", "auc_05")]
    return [*recalls, *ahead(figures), *(f"{figures[key]:.2f}" for key in ("ms_median", "ms_mean", "ms_ratio"))]


def report(title: str, figures: dict[str, dict[str, Any]]) -> None:
    """One group's table in the terminal."""
    table = Table(title=title)
    table.add_column("estimator", overflow="fold")
    for column in COLUMNS:
        table.add_column(column, justify="right")
    for spec, own in figures.items():
        table.add_row(spec, *cells(own))
    console.print(table)


def recall_table(figures: dict[str, dict[str, dict[str, Any]]], pairs: list[ImagePair], seeds: int) -> str:
    """Recall at 0.05 / at 0.01 / AUC@0.05 of each family, and the median time over all: a row an estimator."""
    counts = {group: int(inside.sum()) for group, inside in groups(pairs).items()}
    shown = [group for group in figures if group != "all" and not group.endswith("baselines")]
    head = ["estimator", *(f"{group} ({counts[group]})" for group in shown)]
    lines = [f"| {' | '.join([*head, 'ms'])} |", f"| --- {'| ---: ' * (len(head))}|"]
    for spec, whole in figures[list(figures)[-1]].items():
        recalls = ["{recall_05:.1f} / {recall_01:.1f} / {auc_05:.1f}".format(**figures[group][spec]) for group in shown]
        lines.append(f"| `{spec}` | {' | '.join(recalls)} | {whole['ms_median']:.1f} |")
    note = (
        "Recall at NSGD 0.05 / at 0.01 / AUC@0.05 (area under the recall curve to NSGD 0.05), in %; pairs in brackets; "
        f"mean of {seeds} seeds; median milliseconds of processor time a pair over all, one thread."
    )
    return "\n".join([note, "", *lines])


def difference_table(figures: dict[str, dict[str, dict[str, Any]]], pairs: list[ImagePair], seeds: int) -> str:
    """What the first estimator is ahead of each by, on wide and on short baselines, with intervals; times."""
    counts = {group: int(inside.sum()) for group, inside in groups(pairs).items()}
    shown = [group for group in figures if group.endswith("baselines")] or [list(figures)[-1]]
    first = next(iter(figures[shown[0]]))
    head = ["estimator"]
    for group in shown:
        head += [f"{group} ({counts[group]})", "ahead, R.01", "ahead, AUC@0.05"]
    lines = [f"| {' | '.join([*head, 'time'])} |", f"| --- {'| ---: ' * (len(head))}|"]
    for spec, whole in figures[list(figures)[-1]].items():
        cell = [f"`{spec}`"]
        for group in shown:
            own = figures[group][spec]
            cell.append("{recall_05:.1f} / {recall_01:.1f} / {auc_05:.1f}".format(**own))
            cell += ahead(own)
        lines.append(f"| {' | '.join(cell)} | {whole['ms_ratio']:.2f} |")
    note = (
        f"What `{first}` is ahead by: mean difference of recall at 0.01 and of AUC@0.05, in points, with its 95 % "
        f"bootstrap interval, clustered by scene; {seeds} seeds. Time: median ratio to that of `{first}`, pair by pair."
    )
    return "\n".join([note, "", *lines])


def write(
    path: Path, marker: str, figures: dict[str, dict[str, dict[str, Any]]], pairs: list[ImagePair], seeds: int
) -> None:
    """The tables between their markers in a Markdown file. Raises SystemExit where it has none of these markers."""
    written = [
        replaced(path, name, make(figures, pairs, seeds))
        for name, make in ((marker, recall_table), (f"{marker} differences", difference_table))
    ]
    if not any(written):
        raise SystemExit(f"{path} has no lines <!-- {marker} --> and <!-- end {marker} -->")


def replaced(path: Path, name: str, text: str) -> bool:
    """Whether there are lines ``<!-- name -->`` and ``<!-- end name -->``; what stands between becomes the text."""
    pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end {name} -->)", re.DOTALL)
    content = path.read_text()
    path.write_text(pattern.sub(lambda found: f"{found[1]}{text}\n{found[2]}", content))
    return bool(pattern.search(content))


def compare(figures: dict[str, dict[str, dict[str, Any]]], before: dict[str, dict[str, dict[str, Any]]]) -> None:
    """How recall and time differ from an earlier run's, group by group."""
    keys = ("recall_05", "recall_01", "auc_05", "ms_median")
    for group in figures.keys() & before.keys():
        for spec in figures[group].keys() & before[group].keys():
            now, then = figures[group][spec], before[group][spec]
            changes = ", ".join(f"{key} {now[key] - then[key]:+.2f}" for key in keys)
            console.print(f"{group}, {spec} against the baseline: {changes}")
