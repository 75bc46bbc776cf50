"""Pruners on the same matches with RANSAC: recall, inlier rates and counts before and after estimation.

python -m scripts.benchmark pruning --root DATA/Strecha --root DATA/KITTI --rendered small --json FILE
python -m scripts.benchmark pruning --from FILE FILE --markdown docs/appendix/pruning.md
python -m scripts.benchmark pruning --contrib-python ENVIRONMENT/bin/python      # also times GMS against OpenCV's

ASIFT features take a minute a pair: --asift-limit pairs of each family have them, by default 10.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import platform
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import track

from fmtorch import presets
from fmtorch.core.stages import pruned
from fmtorch.data import ImagePair
from fmtorch.evaluation.rows import evaluate
from fmtorch.evaluation.run import select
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from fmtorch.runs.feature_cache import cached
from scripts.benchmark import pruning_speed, pruning_table
from scripts.benchmark.matched import add_set_arguments, pruner, sets_of
from scripts.benchmark.sheet import put

console = Console(width=None if sys.stdout.isatty() else 160)
# Method: features, then pruners in order, with options as name:key=value. One match per location everywhere but in the
# paper's own baseline; CODE takes all nearest neighbours, so that its survivors are thinned out afterwards.
METHODS = {
    "none": ("sift", "one_to_one"),
    "RATIO, many a location": ("sift", "ratio"),
    "RATIO": ("sift", "ratio one_to_one"),
    "GMS": ("sift", "ratio one_to_one gms"),
    "GMS, scale": ("sift", "ratio one_to_one gms:with_scale=true"),
    "LPM": ("sift", "ratio one_to_one lpm"),
    "frame consistency": ("sift", "ratio one_to_one frame_consistency likely"),
    "CODE on SIFT": ("sift", "code one_to_one"),
    "CODE": ("asift", "code one_to_one"),
}


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("pruning", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_set_arguments(parser)
    parser.add_argument("--asift-limit", type=int, default=10, help="pairs of each family with ASIFT features at most")
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--estimator", default="ransac_eight_point")
    parser.add_argument("--cache", default="off", help="a folder that keeps features from run to run; off: nowhere")
    parser.add_argument("--json", type=Path, help="write the figures of every pair here")
    parser.add_argument("--from", nargs="*", type=Path, default=[], dest="earlier", help="add earlier runs' --json")
    parser.add_argument("--markdown", type=Path, help="put the tables between the marks of this file")
    parser.add_argument("--contrib-python", help="a Python with opencv-contrib: times GMS against its matchGMS")
    parser.add_argument("--repeats", type=int, default=31, help="of each timing")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    runs = [json.loads(path.read_text()) for path in arguments.earlier]
    if arguments.root or arguments.rendered:
        runs.append({"machine": machine(), "rows": list(measure(arguments))})
    if arguments.contrib_python:
        speed = pruning_speed.measure(arguments.contrib_python, arguments.repeats)
        runs.append({"machine": machine(), "speed": speed, "memory": pruning_speed.memory()})
    merged = {
        "machine": [r["machine"] for r in runs],
        **{part: [line for r in runs for line in r.get(part, [])] for part in ("rows", "speed", "memory")},
    }
    merged["rows"] = list({(row["pair"], row["method"]): row for row in merged["rows"]}.values())  # the last of equals
    tables = pruning_table.tables(merged)
    for table in tables:
        console.print(table.terminal())
    if arguments.json:
        arguments.json.write_text(json.dumps(merged, indent=0) + "\n")
    if arguments.markdown:
        put(arguments.markdown, tables)


def machine() -> dict[str, str]:
    return {"processor": platform.processor() or platform.machine(), "torch": torch.__version__}


def measure(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each method and pair."""
    pairs = [dataset[i] for dataset in sets_of(arguments) for i in range(len(dataset))]
    estimator = presets.build("estimator", arguments.estimator)
    for extractor, limit in (("sift", arguments.limit), ("asift", arguments.asift_limit)):
        chosen = {name: METHODS[name][1] for name in arguments.methods if METHODS[name][0] == extractor}
        if not chosen:
            continue
        features = cached(presets.build("features", extractor), arguments.cache)
        front = Pipeline(features, presets.build("matcher", "nearest"), {}, estimator)
        pruners = {name: [pruner(spec) for spec in chain.split()] for name, chain in chosen.items()}
        for pair in track(select(select(pairs, arguments.limit), limit), extractor, console=console):
            yield from rows(front, pair, pruners)


def rows(front: Pipeline, pair: ImagePair, methods: dict[str, list[Any]]) -> Iterator[dict[str, Any]]:
    matched = front.correspondences([pair])[0]
    for name, pruners in methods.items():
        row = evaluate(front.estimate([pruned_by(matched, pruners, front)]))[0]
        kept = ("pair", "family", "scene", "ok", "nsgd", "inlier_rate", "inlier_rate_before", "corrs", "corrs_before")
        yield {"method": name, **{field: getattr(row, field) for field in kept}}


def pruned_by(outcome: Outcome, pruners: list[Any], pipeline: Pipeline) -> Outcome:
    """The outcome after more pruners; those that look at images ask the pipeline for them."""
    c = outcome.correspondences
    if c is None:
        return outcome
    for stage in pruners:
        c = pruned(stage, c, lambda _: pipeline.images(outcome.pair)).compact()
    return dataclasses.replace(outcome, correspondences=c)
