"""Tables of estimators' figures, in the terminal and in Markdown files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from rich.table import Table

from fmtorch.data import ImagePair
from fmtorch.evaluation.statistics import MERITS, described
from scripts.benchmark.matched import console, groups, scenes

COLUMNS = ("R.05", "R.01", "AUC@0.05", "first minus this: R.01", "AUC@0.05", "ms median", "ms mean", "ratio")


Figures = dict[str, dict[str, Any]]  # of each estimator
Groups = dict[str, Figures]


def ahead(figures: Figures, spec: str) -> list[str]:
    """What the first has more in recall at 0.01 and in AUC@0.05, with intervals; empty for the first itself."""
    if spec == next(iter(figures)):
        return ["", ""]
    leads = (figures[spec][key] for key in ("ahead_recall_01", "ahead_auc_05"))
    return ["n too small" if i is None else "{:+.1f} [{:+.1f}, {:+.1f}]".format(*i) for i in leads]


def cells(figures: Figures, spec: str) -> list[str]:
    """One estimator's row of COLUMNS."""
    own = figures[spec]
    recalls = [f"{own[name]:.1f}" for name in MERITS]
    return [*recalls, *ahead(figures, spec), *(f"{own[key]:.2f}" for key in ("ms_median", "ms_mean", "ms_ratio"))]


def recalls(own: dict[str, Any]) -> str:
    """Recall at 0.05 / at 0.01 / AUC@0.05, as one cell."""
    return " / ".join(f"{own[name]:.1f}" for name in MERITS)


def report(title: str, figures: Figures) -> None:
    """One group's table in the terminal."""
    table = Table(title=title)
    table.add_column("estimator", overflow="fold")
    for column in COLUMNS:
        table.add_column(column, justify="right")
    for spec in figures:
        table.add_row(spec, *cells(figures, spec))
    console.print(table)


def recall_table(figures: Groups, pairs: list[ImagePair], seeds: int) -> str:
    """Recall at 0.05 / at 0.01 / AUC@0.05 of each family, and the median time over all: a row an estimator."""
    counts = {group: int(inside.sum()) for group, inside in groups(pairs).items()}
    shown = [group for group in figures if group != "all" and not group.endswith("baselines")]
    head = ["estimator", *(f"{group} ({counts[group]})" for group in shown)]
    lines = [f"| {' | '.join([*head, 'ms'])} |", f"| --- {'| ---: ' * (len(head))}|"]
    for spec, overall in figures[list(figures)[-1]].items():
        own = [recalls(figures[group][spec]) for group in shown]
        lines.append(f"| `{spec}` | {' | '.join(own)} | {overall['ms_median']:.1f} |")
    note = (
        "Recall at NSGD 0.05 / at 0.01 / AUC@0.05 (area under the recall curve to NSGD 0.05), in %; pairs in brackets; "
        f"mean of {seeds} seeds; median milliseconds of processor time a pair over all, one thread."
    )
    return "\n".join([note, "", *lines])


def difference_table(figures: Groups, pairs: list[ImagePair], seeds: int) -> str:
    """The lead of the first estimator over each, on wide and on short baselines, with intervals; times."""
    counts = {group: int(inside.sum()) for group, inside in groups(pairs).items()}
    shown = [group for group in figures if group.endswith("baselines")] or [list(figures)[-1]]
    first = next(iter(figures[shown[0]]))
    head = ["estimator"]
    for group in shown:
        head += [f"{group} ({counts[group]})", "lead, R.01", "lead, AUC@0.05"]
    lines = [f"| {' | '.join([*head, 'time'])} |", f"| --- {'| ---: ' * (len(head))}|"]
    for spec, overall in figures[list(figures)[-1]].items():
        cell = [f"`{spec}`"]
        for group in shown:
            cell += [recalls(figures[group][spec]), *ahead(figures[group], spec)]
        lines.append(f"| {' | '.join(cell)} | {overall['ms_ratio']:.2f} |")
    inside = groups(pairs)
    places = [
        f"{group}, {described([scene for scene, member in zip(scenes(pairs), inside[group], strict=True) if member])}"
        for group in shown
    ]
    note = (
        f"Lead of `{first}` over each estimator: mean difference of recall at 0.01 and of AUC@0.05, in points, with "
        f"its 95 % interval ({'; '.join(places)}); {seeds} seeds. "
        f"Time: median ratio to that of `{first}`, pair by pair."
    )
    return "\n".join([note, "", *lines])


def write(path: Path, marker: str, figures: Groups, pairs: list[ImagePair], seeds: int) -> None:
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
    path.write_text(pattern.sub(lambda match: f"{match[1]}{text}\n{match[2]}", content))
    return bool(pattern.search(content))


def compare(figures: Groups, before: Groups) -> None:
    """How recall and time differ from an earlier run's, group by group."""
    keys = (*MERITS, "ms_median")
    for group in figures.keys() & before.keys():
        for spec in figures[group].keys() & before[group].keys():
            now, then = figures[group][spec], before[group][spec]
            changes = ", ".join(f"{key} {now[key] - then[key]:+.2f}" for key in keys)
            console.print(f"{group}, {spec} against the baseline: {changes}")
