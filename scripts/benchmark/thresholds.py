"""The best threshold of each estimator on tuning data: AUC@0.05 averaged over the families, so each counts alike.

python -m scripts.benchmark thresholds --root DATA/castle --root DATA/fox --rendered small --split train \\
    --values 0.35 0.5 0.75 1 1.5 2 3 --estimators poselib:prosac=true opencv:method=usac_magsac
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch
from rich.table import Table

from fmtorch.evaluation.statistics import areas
from scripts.benchmark import estimators, matched
from scripts.benchmark.matched import console, groups


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("thresholds", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    matched.add_arguments(parser)
    parser.add_argument("--estimators", nargs="+", required=True, help="PRESET[:KEY=VALUE,...][@PRUNER+...]")
    parser.add_argument("--option", default="threshold", help="the option that is varied")
    parser.add_argument("--values", nargs="+", required=True)
    parser.add_argument("--seeds", type=int, default=1)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    items = matched.load(arguments)
    torch.set_num_threads(1)
    families = {g: i for g, i in groups([pair for pair, _ in items]).items() if g not in ("all",) and "base" not in g}
    table = Table(title=f"AUC@0.05, {len(items)} pairs, {arguments.seeds} seeds")
    for column in ("estimator", arguments.option, *families, "mean", "best"):
        table.add_column(column, justify="left" if column == "estimator" else "right")
    for spec in arguments.estimators:
        front, at, stages = spec.partition("@")
        rows = []
        for value in arguments.values:
            option = f"{arguments.option}={value}"
            varied = f"{front}{',' if ':' in front else ':'}{option}{at}{stages}"
            nsgd = estimators.measure([varied], items, arguments.seeds)[varied]["nsgd"]
            per_family = [100 * float(areas(nsgd[:, inside]).mean()) for inside in families.values()]
            rows.append((value, per_family, float(np.mean(per_family))))
        best = max(mean for *_, mean in rows)
        for value, per_family, mean in rows:
            shown = [f"{v:.1f}" for v in (*per_family, mean)]
            table.add_row(spec, value, *shown, "*" if mean == best else "")
    console.print(table)
