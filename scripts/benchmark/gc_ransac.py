"""What GC-RANSAC the paper ran: variants on the same matches, beside its figures.

python -m scripts.benchmark gc_ransac --root DATA/KITTI --root DATA/TUM --limit 24 --markdown docs/appendix/paper.md

Matches are those of VLFeat's SIFT with the ratio test at 0.8. The releases of the authors' software differ in which
matches count at a threshold t: those of a residual below 3.72 t in the first (its weight exp(-r^2 / 2t^2) is above
0.001), below 1.5 t in the next; t is 0.31 px in the article and 2 px in the example that comes with the software.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from rich.progress import track

from fmtorch.core.stages import Estimator
from fmtorch.evaluation.rows import evaluate
from fmtorch.evaluation.run import select
from fmtorch.evaluation.statistics import PERCENT
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.presets import build, load
from fmtorch.runs import PairRow
from scripts.benchmark.early_gc_ransac import EarlyGCRansac
from scripts.benchmark.matched import add_set_arguments, console, sets_of
from scripts.benchmark.paper_table import PAPER
from scripts.benchmark.pruning_table import KIN
from scripts.benchmark.sheet import MISSING, Sheet, published, put
from scripts.benchmark.specs import pipeline_of

ARTICLE, EXAMPLE = (0.31, 0.95), (2.0, 0.99)  # threshold in px, confidence
FIRST, NEXT = math.sqrt(2 * math.log(1000)), 1.5  # residual up to which a match counts, in thresholds
METHOD = "paper/sift_ratio estimator=paper/gc_ransac"
MARKER = "gc_ransac"


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("gc_ransac", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_set_arguments(parser, "pairs of each family at most, chosen by hash")
    parser.add_argument("--cache", default="null", help="folder of features; null: the user's")
    parser.add_argument("--markdown", type=Path, help="put the table between the marks `gc_ransac` of this file")
    parser.set_defaults(run=run)


def variants() -> dict[str, Estimator]:
    """The estimators that are compared, by what the table calls them."""
    estimators: dict[str, Estimator] = {}
    for threshold in (0.31, 2.0, 3.0):
        options = article(threshold)
        estimators[f"`paper/gc_ransac` as in the article, {threshold:g} px"] = build(
            "estimator", "paper/gc_ransac", **options
        )
    estimators["`paper/gc_ransac`, MSAC's score"] = build("estimator", "paper/gc_ransac", score="msac")
    estimators["`paper/gc_ransac`"] = build("estimator", "paper/gc_ransac")
    for release, factor in (("next", NEXT), ("first", FIRST)):
        for source, (threshold, confidence) in (("article", ARTICLE), ("example", EXAMPLE)):
            within = factor * threshold
            for normalized in (False, True) if source == "example" else (False,):
                fit = ", normalised last fit" if normalized else ""
                name = f"{release} release, t of the {source}: below {within:.2f} px{fit}"
                estimators[name] = EarlyGCRansac(within, confidence, normalized=normalized).estimator()
    estimators["`paper/lmeds`"] = build("estimator", "paper/lmeds")
    coarse = {**load("estimator", "paper/cf_ransac")["coarse"], **article(ARTICLE[0])}
    estimators["`paper/cf_ransac`, coarse stage as in the article"] = build(
        "estimator", "paper/cf_ransac", coarse=coarse
    )
    estimators["`paper/cf_ransac`"] = build("estimator", "paper/cf_ransac")
    return estimators


def article(threshold: float) -> dict[str, Any]:
    """The options of the article (Barath & Matas, CVPR 2018, section 4), but for the threshold."""
    return {"threshold": threshold, "confidence": ARTICLE[1], "score": "msac"}


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    pairs = select([dataset[i] for dataset in sets_of(arguments) for i in range(len(dataset))], arguments.limit)
    front = pipeline_of(METHOD, "features=sift_vlfeat", f"cache={arguments.cache}")
    matched = [front.correspondences([pair])[0] for pair in track(pairs, "matching", console=console, transient=True)]
    rows: dict[str, list[PairRow]] = {}
    for name, estimator in variants().items():
        estimation = Pipeline(front.extractor, front.matcher, {}, estimator)
        outcomes = track(matched, name, console=console, transient=True)
        rows[name] = [row for outcome in outcomes for row in evaluate(estimation.estimate([outcome]))]
    sheet = table(rows)
    console.print(sheet.terminal())
    if arguments.markdown:
        put(arguments.markdown, [sheet], MARKER)


def table(rows: dict[str, list[PairRow]]) -> Sheet:
    """A line for each variant: kept matches, %Inlier and %Recall of each family."""
    families = list(dict.fromkeys(row.family for row in next(iter(rows.values()))))
    paper = published(PAPER)
    theirs = [paper.get((KIN.get(family, ""), METHOD)) for family in families]
    first = [_published(line) if line else MISSING for line in theirs]
    lines = [["the paper", *first]]
    for name, own in rows.items():
        lines.append([name, *(_figures([row for row in own if row.family == family]) for family in families)])
    count = {family: sum(row.family == family for row in next(iter(rows.values()))) for family in families}
    columns = [f"{family} ({count[family]})" for family in families]
    return Sheet("Kept matches, %Inlier, %Recall, in %", ["", *columns], lines)


def _published(line: dict[str, str]) -> str:
    kept = float(line["corrs"]) / float(line["corrs_m"])
    return f"{PERCENT * kept:.0f} / {float(line['inlier']):.0f} / {line['recall']}"


def _figures(rows: list[PairRow]) -> str:
    kept = np.mean([row.corrs / row.corrs_before for row in rows if row.ok])
    inlier = np.nanmean([row.inlier_rate for row in rows if row.ok])
    recall = np.mean([row.nsgd < 0.05 for row in rows])
    return f"{PERCENT * kept:.0f} / {PERCENT * inlier:.0f} / {PERCENT * recall:.1f}"
