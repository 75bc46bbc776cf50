"""The figures of `scripts/benchmark pipelines` as tables, beside those of the paper."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matched import WIDE
from pruning_table import KIN, RECALL, Sheet, put

from fmtorch.evaluation.bootstrap import Interval, bootstrap_mean, paired_bootstrap

__all__ = ["put", "tables"]

# Bian et al., "An Evaluation of Feature Matchers for Fundamental Matrix Estimation", BMVC 2019, features and systems.
PAPER = Path(__file__).resolve().parent / "paper_features.csv"
ORDER = (
    ("rootsiftpca_ratio", "sift_ratio"), ("hardnet_ratio", "sift_ratio"), ("hardnet_ratio", "rootsiftpca_ratio"),
    ("hesaffnet_ratio", "hardnet_ratio"), ("hardnet_gms", "rootsiftpca_gms"), ("hesaffnet_gms", "hardnet_gms"),
    ("hesaffnet_gms", "sift_ratio"),
)  # fmt: skip
"""Pairs of pipelines of which the paper has the first above the second on wide baselines."""
REAL = ("Strecha", "PhotoTourism", "CPC", "Tanks_and_Temples", "KITTI", "TUM")
METHODS = [line["method"] for line in csv.DictReader(PAPER.open()) if line["dataset"] == "CPC"]

Row = dict[str, Any]
# A figure of one pair, the mean over seeds; NaN where it is not defined.
FIGURES: dict[str, tuple[Callable[[Row], float], str]] = {
    "%Recall": (lambda row: 100 * float(np.mean([e < RECALL for e in row["nsgd"]])), ".1f"),
    "AUC@0.05": (lambda row: 100 * float(np.mean([max(0.0, 1 - e / RECALL) for e in row["nsgd"]])), ".1f"),
    "%Inlier": (lambda row: 100 * _solved_mean(row, "inlier_rate"), ".1f"),
    "%Inlier-m": (lambda row: 100 * _solved_mean(row, "inlier_rate_before"), ".1f"),
    "#Corrs": (lambda row: _solved_mean(row, "corrs"), ".0f"),
    "#Corrs-m": (lambda row: _solved_mean(row, "corrs_before"), ".0f"),
}


def tables(rows: list[Row]) -> list[Sheet]:
    """A table for each family and one of paired differences; of several rows of a pair the last counts."""
    newest = sorted({(r["method"], r["pair"]): r for r in rows}.values(), key=lambda r: (_place(r), r["method"]))
    paper = {(line["dataset"], line["method"]): line for line in csv.DictReader(PAPER.open())}
    families = sorted({row["family"] for row in newest}, key=lambda f: (f not in REAL, f not in WIDE, f))
    sheets = [_family(family, [r for r in newest if r["family"] == family], paper) for family in families]
    return [*sheets, _order(newest, families)]


def _place(row: Row) -> int:
    """Where a method stands in the tables: as in the paper, those with a label after their like."""
    name = row["method"].split()[0]
    return METHODS.index(name) if name in METHODS else len(METHODS)


def _solved_mean(row: Row, field: str) -> float:
    values = [v for v, ok in zip(row[field], row["ok"], strict=True) if ok and not np.isnan(v)]
    return float(np.mean(values)) if values else np.nan


def _family(family: str, rows: list[Row], paper: dict[tuple[str, str], Any]) -> Sheet:
    pairs, scenes = ({row[field] for row in rows} for field in ("pair", "scene"))
    kin = KIN.get(family, "")
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        known = paper.get((kin, method))
        theirs = " / ".join(known[k] for k in ("recall", "inlier", "inlier_m", "corrs", "corrs_m")) if known else ""
        some = "" if len(own) == len(pairs) else f", {len(own)} pairs"
        lines.append([f"`{method}`{some}", *(_shown(own, name) for name in FIGURES), _failed(own), theirs])
    title = f"{family}: {len(pairs)} pairs of {len(scenes)} scene{'s' * (len(scenes) > 1)}"
    return Sheet(title, ["", *FIGURES, "failed", f"paper, {kin}: recall, inlier, -m, #, -m"], lines)


def _failed(rows: list[Row]) -> str:
    """Pairs without an estimate, as a mean over seeds."""
    return f"{sum(1 - np.mean(row['ok']) for row in rows):.1f}"


def _shown(rows: list[Row], name: str) -> str:
    figure, form = FIGURES[name]
    values = np.array([figure(row) for row in rows], np.float64)
    defined = ~np.isnan(values)
    if not defined.any():
        return "–"
    scenes = [row["scene"] for row, d in zip(rows, defined, strict=True) if d]
    return _interval(bootstrap_mean(values[defined], scenes), form)


def _interval(i: Interval, form: str) -> str:
    return f"{i.value:{form}} [{i.low:{form}}, {i.high:{form}}]"


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
        for better, worse in [*ORDER, *labelled]:
            first, second = by_method.get(better, {}), by_method.get(worse, {})
            common = [pair for pair in first if pair in second and first[pair]["family"] in members]
            if not common or (len(members) < 2 and group not in families):
                continue
            shown = [_difference(name, [first[p] for p in common], [second[p] for p in common])
                     for name in ("%Recall", "AUC@0.05", "%Inlier-m")]  # fmt: skip
            lines.append([f"{group}: `{better}` - `{worse}`", str(len(common)), *shown])
    return Sheet("Paired differences, in points", ["", "pairs", "%Recall", "AUC@0.05", "%Inlier-m"], lines)


def _difference(name: str, first: list[Row], second: list[Row]) -> str:
    a, b = (np.array([FIGURES[name][0](row) for row in rows], np.float64) for rows in (first, second))
    defined = ~(np.isnan(a) | np.isnan(b))
    scenes = [row["scene"] for row, d in zip(first, defined, strict=True) if d]
    return _interval(paired_bootstrap(a[defined], b[defined], scenes), "+.1f") if defined.any() else "–"
