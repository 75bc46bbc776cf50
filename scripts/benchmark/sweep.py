"""Runs of `fmtorch.eval` in one table: a line for each family and pipeline, of pairs that all runs of a data set have.

python -m scripts.benchmark sweep runs --markdown docs/paper.md
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fmtorch.commands.report import run_folders
from fmtorch.data.baselines import WIDE
from fmtorch.evaluation.statistics import PERCENT
from fmtorch.evaluation.summary import ALL, summarize
from fmtorch.storage import RunFolder
from scripts.benchmark.matched import console
from scripts.benchmark.pipelines_table import REAL
from scripts.benchmark.sheet import MISSING, Sheet, put

MARKER = "sweep"
COLUMNS = ("", "pairs", "%Recall", "R.01", "AUC@0.05", "%Inlier", "%Inlier-m", "#Corrs", "#Corrs-m", "failed")


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("sweep", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="folders of runs, or folders that hold such")
    parser.add_argument("--markdown", type=Path, help="put the table between the marks `sweep` of this file")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    groups: dict[tuple[str, str], Mapping[str, Any]] = {}
    folders = [RunFolder.load(path) for path in run_folders(arguments.runs)]
    for folder in folders:
        alike = [other for other in folders if other.config["dataset"] == folder.config["dataset"]]
        summary = summarize(folder.read(set.intersection(*(other.done() for other in alike))))
        groups |= {(family, folder.config["pipeline"]): group for family, group in summary.items() if family != ALL}
    sheet = table(groups)
    console.print(sheet.terminal())
    if arguments.markdown:
        put(arguments.markdown, [sheet], MARKER)


def table(groups: Mapping[tuple[str, str], Mapping[str, Any]]) -> Sheet:
    """A line for each family and pipeline: real families first, wide ones first among them."""
    order = sorted(groups, key=lambda key: (key[0] not in REAL, key[0] not in WIDE, key[0]))
    return Sheet("One sweep over all sets", COLUMNS, [_line(*key, groups[key]) for key in order])


def _line(family: str, pipeline: str, group: Mapping[str, Any]) -> list[str]:
    low, high = group["recall_interval"]
    figures = [_percent(group[name]) for name in ("recall_fine", "auc_05", "inlier_rate", "inlier_rate_before")]
    counts = [MISSING if group[name] is None else f"{group[name]:.0f}" for name in ("corrs", "corrs_before")]
    recall = f"{_percent(group['recall'])} [{_percent(low)}, {_percent(high)}]"
    return [f"{family}: `{pipeline}`", str(group["pairs"]), recall, *figures, *counts, str(group["failures"])]


def _percent(share: float | None) -> str:
    return MISSING if share is None else f"{PERCENT * share:.1f}"
