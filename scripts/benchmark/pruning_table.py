"""The figures of `scripts/benchmark pruning` as tables, beside those of the paper."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from fmtorch.evaluation.bootstrap import bootstrap_mean, paired_bootstrap

# Bian et al., "An Evaluation of Feature Matchers for Fundamental Matrix Estimation", BMVC 2019, tables of pruning.
PAPER = Path(__file__).resolve().parent / "paper_pruning.csv"
# The paper's set of the same kind of camera motion; none of them is the same set.
KIN = {
    "TUM": "TUM", "indoor": "TUM", "KITTI": "KITTI", "driving": "KITTI", "Strecha": "T&T", "orbit": "T&T",
    "PhotoTourism": "CPC", "collection": "CPC",
}  # fmt: skip
RECALL = 0.05  # NSGD
BASELINE = "RATIO"
FIGURES = ("%Recall", f"less {BASELINE}'s", "%Inlier", "%Inlier-m", "#Corrs", "#Corrs-m")
BEGIN, END = "<!-- figures -->", "<!-- end of figures -->"


@dataclasses.dataclass(frozen=True)
class Sheet:
    """A table with a title; the first column is text."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def terminal(self) -> Table:
        table = Table(title=self.title, title_justify="left")
        for i, column in enumerate(self.columns):
            table.add_column(column, justify="right" if i else "left")
        for row in self.rows:
            table.add_row(*row)
        return table

    def markdown(self) -> str:
        lines = [self.columns, ["---", *["---:"] * (len(self.columns) - 1)], *self.rows]
        return f"### {self.title}\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines)


def tables(figures: dict[str, Any]) -> list[Sheet]:
    """A table for each family, and one for its pairs with ASIFT features where those are fewer; then the timings."""
    rows = figures["rows"]
    paper = {(line["dataset"], line["method"]): line for line in csv.DictReader(PAPER.open())}
    sheets = []
    for family in dict.fromkeys(row["family"] for row in rows):
        own = [row for row in rows if row["family"] == family]
        everywhere = {row["pair"] for row in own}
        simulated = {row["pair"] for row in own if row["method"] == "CODE"}
        if simulated != everywhere:
            sheets.append(_family(family, [row for row in own if row["method"] != "CODE"], "", paper))
        if simulated:
            some = "" if simulated == everywhere else " with ASIFT features too"
            sheets.append(_family(family, [row for row in own if row["pair"] in simulated], some, paper))
    titles = {"speed": "Milliseconds of processor time a pair, one thread", "memory": "Peak memory of a call, MiB"}
    for part, title in titles.items():
        if figures[part]:
            names = list(figures[part][0])
            sheets.append(Sheet(title, names, [[str(line[name]) for name in names] for line in figures[part]]))
    return sheets


def _family(family: str, rows: list[dict[str, Any]], some: str, paper: dict[tuple[str, str], Any]) -> Sheet:
    pairs, scenes = ({row[field] for row in rows} for field in ("pair", "scene"))
    title = f"{family}: {len(pairs)} pairs{some} of {len(scenes)} scene{'s' * (len(scenes) > 1)}"
    kin = KIN.get(family)
    heading = f"paper, {kin}: recall, inlier, -m, #, -m" if kin else "paper"
    lines = []
    baseline = {row["pair"]: row for row in rows if row["method"] == BASELINE}
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        known = paper.get((kin or "", method))
        theirs = " / ".join(known[k] for k in ("recall", "inlier", "inlier_m", "corrs", "corrs_m")) if known else ""
        failed = sum(not row["ok"] for row in own)
        recall, *others = _intervals(own)
        lines.append([method, recall, _against(own, baseline), *others, str(failed), theirs])
    return Sheet(title, ["", *FIGURES, "failed", heading], lines)


def _intervals(rows: list[dict[str, Any]]) -> list[str]:
    """The figures with 95 % bootstrap intervals: recall over all pairs, the others over those that did not fail."""
    solved = [row for row in rows if row["ok"]]

    def shown(values: list[float], some: list[dict[str, Any]], form: str) -> str:
        known = np.array(values, np.float64)
        defined = ~np.isnan(known)
        if not defined.any():
            return "–"
        i = bootstrap_mean(known[defined], [row["scene"] for row, d in zip(some, defined, strict=True) if d])
        return f"{i.value:{form}} [{i.low:{form}}, {i.high:{form}}]"

    return [
        shown([100.0 * (row["nsgd"] < RECALL) for row in rows], rows, ".1f"),
        *(shown([100 * row[name] for row in solved], solved, ".1f") for name in ("inlier_rate", "inlier_rate_before")),
        *(shown([row[name] for row in solved], solved, ".0f") for name in ("corrs", "corrs_before")),
    ]


def _against(rows: list[dict[str, Any]], baseline: dict[str, dict[str, Any]]) -> str:
    """The recall, less that of the baseline on the same pairs, with its interval, which is narrower than theirs."""
    if any(row["pair"] not in baseline or row["method"] == BASELINE for row in rows):
        return ""
    paired = [[100.0 * (r["nsgd"] < RECALL) for r in (row, baseline[row["pair"]])] for row in rows]
    own, other = np.array(paired).T
    i = paired_bootstrap(own, other, [row["scene"] for row in rows])
    return f"{i.value:+.1f} [{i.low:+.1f}, {i.high:+.1f}]"


def put(path: Path, sheets: Sequence[Sheet]) -> None:
    """Replace what stands between the marks of a Markdown file. Raises ValueError for a file without them."""
    text = path.read_text()
    if BEGIN not in text or END not in text:
        raise ValueError(f"{path} must hold the lines {BEGIN} and {END}; the tables go between them")
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    path.write_text(before + "\n\n".join([BEGIN, *(sheet.markdown() for sheet in sheets), END]) + after)
