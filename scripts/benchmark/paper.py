"""The paper's comparison of robust estimators with its own settings (`paper/*`), beside its figures.

python -m scripts.benchmark paper --root DATA/KITTI --root DATA/TUM --root DATA/Strecha --json paper.jsonl
python -m scripts.benchmark paper --rendered small --json paper.jsonl
python -m scripts.benchmark paper --from paper.jsonl --markdown docs/appendix/paper.md

All get the same matches: VLFeat's SIFT, as in the paper, with a ratio test at 0.8; RANSAC also gets OpenCV's SIFT, to
compare the matches. --json is appended to batch by batch: started again, the command goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch

from scripts.benchmark import paper_table, pipelines
from scripts.benchmark.kept import read
from scripts.benchmark.matched import add_set_arguments, console
from scripts.benchmark.sheet import put

METHODS = list(paper_table.METHODS)
OPENCV = METHODS[:1]  # what gets OpenCV's matches, too


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("paper", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_set_arguments(parser, "pairs of each family at most, chosen by hash")
    parser.add_argument(
        "--estimators",
        nargs="*",
        default=METHODS,
        choices=METHODS,
        help="pipelines to measure, each one word in quotes",
    )
    pipelines.add_measure_arguments(parser, seeds=3)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    rows = [row for path in arguments.earlier for row in read(path)]
    if arguments.root or arguments.rendered:
        vlfeat = {"pipelines": arguments.estimators, "label": paper_table.VLFEAT, "overrides": ["features=sift_vlfeat"]}
        opencv = {"pipelines": [m for m in OPENCV if m in arguments.estimators], "label": "", "overrides": []}
        for front in (vlfeat, opencv):
            rows += pipelines.measure(argparse.Namespace(**{**vars(arguments), **front}))
    sheets = paper_table.tables(rows)
    for sheet in sheets:
        console.print(sheet.terminal())
    if arguments.markdown:
        put(arguments.markdown, sheets)
