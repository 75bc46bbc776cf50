"""Peak memory of robust estimators: how far the resident set grows during one call, each in a process of its own.

python -m scripts.benchmark memory --pairs 64 --matches 8000 --estimators fmtorch gc_ransac
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from fmtorch import presets
from fmtorch.core.types import collate
from scripts.benchmark.matched import console
from scripts.benchmark.peak import peak_growth
from scripts.benchmark.specs import build
from scripts.benchmark.synthetic import synthetic_pair

OTHER_LIBRARIES = (
    "opencv",
    "poselib",
    "kornia_ransac",
    "magsac_cpp",
    "gc_ransac_cpp",
    "degensac_cpp",
    "superansac_cpp",
)
"""Prefixes of the presets that call other libraries' estimators; of these only OpenCV's keep the laws."""


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("memory", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--estimators", nargs="+", help="PRESET[:KEY=VALUE,...][@PRUNER...]; default: all our own")
    parser.add_argument("--pairs", type=int, default=64)
    parser.add_argument("--matches", type=int, default=8000)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    own = [name for name in presets.available("estimator") if not name.startswith(OTHER_LIBRARIES)]
    table = Table(title=f"{arguments.pairs} pairs of {arguments.matches} matches")
    for column in ("estimator", "input, MiB", "peak growth, MiB"):
        table.add_column(column)
    figures = {}
    context = multiprocessing.get_context("spawn")
    for spec in arguments.estimators or own:
        with context.Pool(1) as pool:  # memory once claimed stays claimed, so each has a fresh process
            size, growth = pool.apply(peak, (spec, arguments.pairs, arguments.matches))
        figures[spec] = {"input_mib": size, "growth_mib": growth}
        table.add_row(spec, f"{size:.0f}", f"{growth:.0f}")
        print(f"{spec}: {growth:.0f} MiB", file=sys.stderr)
    console.print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


def peak(spec: str, pairs: int, matches: int) -> tuple[float, float]:
    """MiB of the input, and by how much the peak of one call exceeds what was resident before."""
    torch.set_num_threads(1)
    estimator = build(spec)
    estimator(synthetic_pair(0, 200, 0), 0)  # lazy initialisation is not counted
    c = collate([synthetic_pair(i, matches, 0) for i in range(pairs)])
    size = sum(value.nbytes for value in vars(c).values() if isinstance(value, torch.Tensor)) / 2**20
    return size, peak_growth(lambda: estimator(c, 0))
