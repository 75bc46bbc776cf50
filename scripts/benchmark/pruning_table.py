"""The figures of `scripts/benchmark pruning` as tables, beside those of the paper."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.evaluation.statistics import PERCENT, described, difference, interval, recalled, scene_names
from scripts.benchmark.sheet import Published, Sheet, compared, published, shown

# Bian et al., "An Evaluation of Feature Matchers for Fundamental Matrix Estimation", BMVC 2019, tables of pruning.
PAPER = Path(__file__).resolve().parent / "paper_pruning.csv"
# The paper's set of the same kind of camera motion; none of them is the same set.
KIN = {
    "TUM": "TUM", "indoor": "TUM", "KITTI": "KITTI", "driving": "KITTI", "Strecha": "T&T", "orbit": "T&T",
    "TanksLike": "T&T", "PhotoTourism": "CPC", "collection": "CPC",
}  # fmt: skip
BASELINE = "RATIO"
FIGURES = ("%Recall", f"less {BASELINE}'s", "%Inlier", "%Inlier-m", "#Corrs", "#Corrs-m")

Row = dict[str, Any]


def tables(figures: dict[str, Any]) -> list[Sheet]:
    """A table for each family, and one for its pairs with ASIFT features where those are fewer; then the timings."""
    rows = figures["rows"]
    paper = published(PAPER)
    sheets = []
    for family in dict.fromkeys(row["family"] for row in rows):
        own = [row for row in rows if row["family"] == family]
        everywhere = {row["pair"] for row in own}
        simulated = {row["pair"] for row in own if row["method"] == "CODE"}
        if simulated != everywhere:
            sheets.append(_family(family, [row for row in own if row["method"] != "CODE"], "", paper))
        if simulated:
            suffix = "" if simulated == everywhere else " with ASIFT features too"
            sheets.append(_family(family, [row for row in own if row["pair"] in simulated], suffix, paper))
    titles = {"speed": "Milliseconds of processor time a pair, one thread", "memory": "Peak memory of a call, MiB"}
    for part, title in titles.items():
        if figures[part]:
            names = list(figures[part][0])
            sheets.append(Sheet(title, names, [[str(line[name]) for name in names] for line in figures[part]]))
    return sheets


def _family(family: str, rows: list[Row], suffix: str, paper: Published) -> Sheet:
    kin = KIN.get(family, "")
    heading = f"paper, {kin}: recall, inlier, -m, #, -m" if kin else "paper"
    title = f"{family}{suffix}: {described(scenes_of({row['pair']: row for row in rows}.values()))}"
    lines = []
    baseline = {row["pair"]: row for row in rows if row["method"] == BASELINE}
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        failed = sum(not row["ok"] for row in own)
        recall, *others = _intervals(own)
        theirs = compared(paper, kin, method)
        lines.append([method, recall, _against(own, baseline), *others, str(failed), theirs])
    return Sheet(title, ["", *FIGURES, "failed", heading], lines)


def scenes_of(rows: Iterable[Row]) -> list[str]:
    """The scene of each row, with its family."""
    rows = list(rows)
    return scene_names([row["family"] for row in rows], [row["scene"] for row in rows])


def nsgd_of(rows: Iterable[Row]) -> NDArray[np.float64]:
    """NSGD of each row, (n,)."""
    return np.array([row["nsgd"] for row in rows], np.float64)


def _intervals(rows: list[Row]) -> list[str]:
    """The figures with 95 % intervals: recall over all pairs, the others over those that did not fail."""
    solved = [row for row in rows if row["ok"]]
    figures = [("inlier_rate", PERCENT, ".1f"), ("inlier_rate_before", PERCENT, ".1f"), ("corrs", 1.0, ".0f"),
               ("corrs_before", 1.0, ".0f")]  # fmt: skip
    return [
        shown(interval(recalled(nsgd_of(rows)), scenes_of(rows), PERCENT, share=True), ".1f"),
        *(
            shown(interval(np.array([row[name] for row in solved], np.float64), scenes_of(solved), scale), form)
            for name, scale, form in figures
        ),
    ]


def _against(rows: list[Row], baseline: dict[str, Row]) -> str:
    """The recall, less that of the baseline on the same pairs, with its interval, which is narrower than theirs."""
    if any(row["pair"] not in baseline or row["method"] == BASELINE for row in rows):
        return ""
    other = [baseline[row["pair"]] for row in rows]
    return shown(
        difference(recalled(nsgd_of(rows)), recalled(nsgd_of(other)), scenes_of(rows), PERCENT, share=True), "+.1f"
    )
