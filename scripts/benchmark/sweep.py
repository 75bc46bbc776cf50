"""Runs of `fmtorch.eval` in one table: a line for each family and pipeline, of pairs that all runs of a data set have.

python -m scripts.benchmark sweep runs --against 'code estimator=lmeds_eight_point' sift_code_lmeds \\
    --markdown docs/appendix/paper.md

--against adds the differences of all other pipelines to these, on the pairs that both have.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from fmtorch import presets
from fmtorch.commands.report import run_folders
from fmtorch.evaluation.statistics import MERITS, PERCENT, SHARES, described, difference, scene_names
from fmtorch.evaluation.summary import ALL, summarize
from fmtorch.presets.pruners import WIDE
from fmtorch.runs import RunFolder
from scripts.benchmark.matched import console
from scripts.benchmark.pipelines_table import PAPER, REAL
from scripts.benchmark.pruning_table import KIN
from scripts.benchmark.sheet import MISSING, Published, Sheet, compared, published, put, shown

MARKER = "sweep"
COLUMNS = (
    "", "pairs", "%Recall", "R.01", "AUC@0.05", "%Inlier", "%Inlier-m", "#Corrs", "#Corrs-m", "failed",
    "paper: recall, inlier, -m, #, -m",
)  # fmt: skip
NAMES = {"recall_05": "%Recall", "recall_01": "R.01", "auc_05": "AUC@0.05"}
Place = tuple[str, str]  # a family and a pipeline


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("sweep", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="folders of runs, or folders that hold such")
    parser.add_argument("--against", nargs="*", default=[], help="pipelines that the others are compared with")
    parser.add_argument("--markdown", type=Path, help="put the tables between the marks `sweep` of this file")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    rows: dict[Place, pa.Table] = {}
    groups: dict[Place, Mapping[str, Any]] = {}
    folders = [RunFolder.load(path) for path in run_folders(arguments.runs)]
    for folder in folders:
        alike = [other for other in folders if other.config["dataset"] == folder.config["dataset"]]
        table = folder.read(set.intersection(*(other.done() for other in alike)))
        name = method_of(folder.config)
        groups |= {(family, name): group for family, group in summarize(table).items() if family != ALL}
        families = np.array(table["family"].to_pylist())
        rows |= {(family, name): table.filter(pa.array(families == family)) for family in np.unique(families)}
    sheets = [sweep(groups)]
    if arguments.against:
        sheets.append(differences(rows, arguments.against))
    for sheet in sheets:
        console.print(sheet.terminal())
    if arguments.markdown:
        put(arguments.markdown, sheets, MARKER)


def method_of(config: Mapping[str, Any]) -> str:
    """The pipeline of a run and, where it is not the pipeline's own, its estimator: ``code estimator=lmeds``."""
    name = str(config["pipeline"])
    estimator, usual = config.get("estimator"), presets.pipeline_stages(name)
    close = presets.closest("estimator", estimator) if usual and estimator and estimator != usual["estimator"] else None
    return name if close is None else f"{name} estimator={close[0]}"


def _order(places: Mapping[Place, Any]) -> list[Place]:
    """Real families first, wide ones first among them."""
    return sorted(places, key=lambda place: (place[0] not in REAL, place[0] not in WIDE, place[0]))


def sweep(groups: Mapping[Place, Mapping[str, Any]]) -> Sheet:
    """A line for each family and pipeline."""
    paper = published(PAPER)
    return Sheet("One sweep over all sets", COLUMNS, [_line(*place, groups[place], paper) for place in _order(groups)])


def _line(family: str, pipeline: str, group: Mapping[str, Any], paper: Published) -> list[str]:
    low, high = group["recall_interval"]
    figures = [_percent(group[name]) for name in ("recall_fine", "auc_05", "inlier_rate", "inlier_rate_before")]
    counts = [MISSING if group[name] is None else f"{group[name]:.0f}" for name in ("corrs", "corrs_before")]
    recall = f"{_percent(group['recall'])} [{_percent(low)}, {_percent(high)}]"
    theirs = compared(paper, KIN.get(family, ""), pipeline)
    cells = [recall, *figures, *counts, str(group["failures"]), theirs]
    return [f"{family}: `{pipeline}`", str(group["pairs"]), *cells]


def differences(rows: Mapping[Place, pa.Table], against: Sequence[str]) -> Sheet:
    """What each pipeline has more than those of `against`, on the pairs that both have, with intervals."""
    lines = []
    for i, reference in enumerate(against):
        for family, pipeline in _order(rows):
            if pipeline not in against[: i + 1] and (family, reference) in rows:  # no two lines of the same two
                lines += _difference(family, pipeline, reference, rows)
    heads = [*NAMES.values(), "paper: %Recall"]
    return Sheet("Paired differences, in points", ["", "of", *heads], lines)


def _difference(family: str, pipeline: str, reference: str, rows: Mapping[Place, pa.Table]) -> list[list[str]]:
    """One line, or none where no pair is common."""
    first, second = (_by_key(rows[family, name]) for name in (pipeline, reference))
    common = sorted(first.keys() & second.keys())
    if not common:
        return []
    scenes = scene_names([family] * len(common), [first[key][1] for key in common])
    own, other = (np.array([by_key[key][0] for key in common]) for by_key in (first, second))
    cells = []
    for name in NAMES:
        merit = MERITS[name]
        gain = difference(merit(own), merit(other), scenes, PERCENT, share=name in SHARES)
        cells.append(shown(gain, "+.1f"))
    paper, kin = published(PAPER), KIN.get(family, "")
    theirs = [paper.get((kin, name)) for name in (pipeline, reference)]
    return [[f"{family}: `{pipeline}` - `{reference}`", described(scenes), *cells, _published(theirs)]]


def _published(lines: Sequence[Mapping[str, str] | None]) -> str:
    """The paper's difference of %Recall of two pipelines."""
    recalls = [float(line["recall"]) for line in lines if line]
    return f"{recalls[0] - recalls[1]:+.1f}" if len(recalls) == 2 else MISSING


def _by_key(table: pa.Table) -> dict[int, tuple[float, str]]:
    """NSGD, 1 for a failure, and scene of each pair."""
    key, nsgd, scene = (table[name].to_pylist() for name in ("key", "nsgd", "scene"))
    return dict(zip(key, zip(nsgd, scene, strict=True), strict=True))


def _percent(share: float | None) -> str:
    return MISSING if share is None else f"{PERCENT * share:.1f}"
