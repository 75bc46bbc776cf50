"""The figures of `scripts/benchmark pipelines` as tables, beside those of the paper."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fmtorch.evaluation.statistics import PERCENT, areas, described, difference, interval, recalled
from fmtorch.presets.pruners import WIDE
from scripts.benchmark.pruning_table import KIN, Row, scenes_of
from scripts.benchmark.sheet import Published, Sheet, compared, published, shown

# Bian et al., "An Evaluation of Feature Matchers for Fundamental Matrix Estimation", BMVC 2019, features and systems.
PAPER = Path(__file__).resolve().parent / "paper_features.csv"
ORDER = (
    ("rootsiftpca_ratio", "sift_ratio"), ("hardnet_ratio", "sift_ratio"), ("hardnet_ratio", "rootsiftpca_ratio"),
    ("hesaffnet_ratio", "hardnet_ratio"), ("hardnet_gms", "rootsiftpca_gms"), ("hesaffnet_gms", "hardnet_gms"),
    ("hesaffnet_gms", "sift_ratio"),
)  # fmt: skip
"""Pairs of pipelines of which the paper has the first above the second on wide baselines."""
FASTER = (("hesaffnet_fast_fmtorch", "hesaffnet_fmtorch"),)
"""A pipeline of smaller networks, and that of their teachers."""
REAL = ("Strecha", "PhotoTourism", "CPC", "Tanks_and_Temples", "TanksLike", "KITTI", "TUM")
METHODS = [method for dataset, method in published(PAPER) if dataset == "CPC"]

Values = NDArray[np.float64]
# A figure of each pair, (n,), the mean over seeds; NaN where it is not defined. Its factor and format.
FIGURES: dict[str, tuple[Callable[[list[Row]], Values], float, str]] = {
    "%Recall": (lambda rows: recalled(nsgd_by_seed(rows)), PERCENT, ".1f"),
    "AUC@0.05": (lambda rows: areas(nsgd_by_seed(rows)), PERCENT, ".1f"),
    "%Inlier": (lambda rows: solved_means(rows, "inlier_rate"), PERCENT, ".1f"),
    "%Inlier-m": (lambda rows: solved_means(rows, "inlier_rate_before"), PERCENT, ".1f"),
    "#Corrs": (lambda rows: solved_means(rows, "corrs"), 1.0, ".0f"),
    "#Corrs-m": (lambda rows: solved_means(rows, "corrs_before"), 1.0, ".0f"),
}

SHARES = ("%Recall",)


def tables(rows: list[Row]) -> list[Sheet]:
    """A table for each family and one of paired differences; of several rows of a pair the last counts."""
    newest = sorted({(r["method"], r["pair"]): r for r in rows}.values(), key=lambda r: (_place(r), r["method"]))
    paper = published(PAPER)
    families = sorted({row["family"] for row in newest}, key=lambda f: (f not in REAL, f not in WIDE, f))
    sheets = [_family(family, [r for r in newest if r["family"] == family], paper) for family in families]
    return [*sheets, _order(newest, families)]


def _place(row: Row) -> int:
    """Where a method stands in the tables: as in the paper, those with a label after their like."""
    name = row["method"].split()[0]
    return METHODS.index(name) if name in METHODS else len(METHODS)


def nsgd_by_seed(rows: list[Row]) -> Values:
    """(seeds, n)."""
    return np.array([row["nsgd"] for row in rows], np.float64).T


def solved_means(rows: list[Row], field: str) -> Values:
    """The mean of each pair over the seeds with which it was solved, (n,); NaN where there is none."""
    values = np.array([row[field] for row in rows], np.float64)
    solved = np.array([row["ok"] for row in rows], bool) & ~np.isnan(values)
    total, count = np.where(solved, values, 0.0).sum(1), solved.sum(1)
    means: Values = np.divide(total, count, out=np.full(len(rows), np.nan), where=count > 0)
    return means


def _family(family: str, rows: list[Row], paper: Published) -> Sheet:
    pairs = {row["pair"]: row for row in rows}
    kin = KIN.get(family, "")
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        note = "" if len(own) == len(pairs) else f", {len(own)} pairs"
        figures = [_interval(name, own) for name in FIGURES]
        lines.append([f"`{method}`{note}", *figures, failed(own), compared(paper, kin, method)])
    title = f"{family}: {described(scenes_of(pairs.values()))}"
    return Sheet(title, ["", *FIGURES, "failed", f"paper, {kin}: recall, inlier, -m, #, -m"], lines)


def failed(rows: list[Row]) -> str:
    """Pairs without an estimate, as a mean over seeds."""
    return f"{sum(1 - np.mean(row['ok']) for row in rows):.1f}"


def _order(rows: list[Row], families: list[str]) -> Sheet:
    """What one pipeline has more than another on the same pairs: %Recall, AUC@0.05 and %Inlier-m.

    Those with a label are compared with their like without one.
    """
    by_method = {m: {r["pair"]: r for r in rows if r["method"] == m} for m in {row["method"] for row in rows}}
    groups = {family: [family] for family in families}
    wide = [family for family in families if family in WIDE]
    groups |= {"wide baselines": wide, "short baselines": [family for family in families if family not in WIDE]}
    labelled = sorted((name, name.split()[0]) for name in by_method if " " in name)
    lines = []
    for group, members in groups.items():
        for better, worse in [*ORDER, *FASTER, *labelled]:
            first, second = by_method.get(better, {}), by_method.get(worse, {})
            common = [pair for pair in first if pair in second and first[pair]["family"] in members]
            if not common or (len(members) < 2 and group not in families):
                continue
            cells = [_difference(name, [first[p] for p in common], [second[p] for p in common])
                     for name in ("%Recall", "AUC@0.05", "%Inlier-m")]  # fmt: skip
            place = described(scenes_of([first[p] for p in common]))
            lines.append([f"{group}: `{better}` - `{worse}`", place, *cells])
    return Sheet("Paired differences, in points", ["", "of", "%Recall", "AUC@0.05", "%Inlier-m"], lines)


def _interval(name: str, rows: list[Row]) -> str:
    figure, scale, form = FIGURES[name]
    return shown(interval(figure(rows), scenes_of(rows), scale, share=name in SHARES), form)


def _difference(name: str, first: list[Row], second: list[Row]) -> str:
    figure, scale, _ = FIGURES[name]
    i = difference(figure(first), figure(second), scenes_of(first), scale, share=name in SHARES)
    return shown(i, "+.1f")
