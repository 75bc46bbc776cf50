"""Accuracy against time: estimators at several numbers of samples, their curves as JSON, figure and table, with knees.

The knee of a curve is its cheapest point within 0.5 points of its best AUC@0.05, averaged over the families. It is
chosen on tuning data, and marked on the curves of test data.

python -m scripts.benchmark curves --root DATA/Strecha_train --root DATA/TanksLike --rendered full --split train \\
    --limit 60 --json tuning.json
python -m scripts.benchmark curves --root DATA/Strecha --root DATA/KITTI --knees tuning.json \\
    --svg docs/appendix/estimators_curves.svg --update docs/appendix/estimators.md
"""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from fmtorch.data import ImagePair
from fmtorch.evaluation.statistics import MERITS, PERCENT
from scripts.benchmark import matched
from scripts.benchmark.curves_figure import figure
from scripts.benchmark.estimators import Result, measure
from scripts.benchmark.estimators_table import replaced
from scripts.benchmark.kept import Kept
from scripts.benchmark.matched import console, groups

KNEE_TOLERANCE = 0.5  # points of AUC@0.05 below the best of its curve
SPECS = Path(__file__).with_name("curves.txt")


class Curve(NamedTuple):
    """The estimators along a curve, and what is varied between them."""

    name: str
    specs: tuple[str, ...]
    values: tuple[str, ...]


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("curves", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    matched.add_arguments(parser)
    parser.add_argument("--specs", type=Path, default=SPECS, help="the curves; each line: CURVE | ESTIMATOR | VALUES")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument(
        "--rows", type=Path, help="keep what each estimator makes of each pair here, as `estimators` does"
    )
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--knees", type=Path, help="a file of --json, measured on tuning data, whose knees are marked")
    parser.add_argument("--svg", type=Path, help="draw the curves into this file")
    parser.add_argument("--update", type=Path, help="write the table into this Markdown file, between its markers")
    parser.add_argument("--marker", default="curves", help="<!-- NAME --> and <!-- end NAME -->")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    curves = read(arguments.specs)
    kept = Kept(arguments.rows)
    items = matched.load(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    pairs = [pair for pair, _ in items]
    specs = list(dict.fromkeys(spec for curve in curves for spec in curve.specs))
    results = measure(specs, items, arguments.seeds, kept=kept, matches=matched.identity(arguments))
    figures = summaries(results, pairs)
    knees = {curve.name: knee(curve, figures) for curve in curves}
    if arguments.knees:
        knees = json.loads(arguments.knees.read_text())["knees"]
    text = table(curves, figures, knees, arguments.seeds)
    console.print(text, markup=False)
    if arguments.json:
        machine = {"processor": platform.processor() or platform.machine(), "torch": torch.__version__}
        content = {
            "machine": machine,
            "pairs": len(pairs),
            "seeds": arguments.seeds,
            "knees": knees,
            "figures": figures,
        }
        arguments.json.write_text(json.dumps(content, indent=1) + "\n")
    if arguments.svg:
        arguments.svg.write_text(figure({curve.name: curve.specs for curve in curves}, figures, knees))
    if arguments.update and not replaced(arguments.update, arguments.marker, text):
        raise SystemExit(
            f"{arguments.update} has no lines <!-- {arguments.marker} --> and <!-- end {arguments.marker} -->"
        )


def read(path: Path) -> list[Curve]:
    """The curves of a file. Raises SystemExit for a line without three parts, naming it."""
    curves = []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        parts = [part.strip() for part in text.split("|")]
        if len(parts) != 3 or "{}" not in parts[1] or not parts[2]:
            raise SystemExit(f"{path}:{number}: {text!r} is not CURVE | ESTIMATOR with {{}} | VALUES")
        name, spec, values = parts[0], parts[1], tuple(parts[2].split())
        curves.append(Curve(name, tuple(spec.replace("{}", value) for value in values), values))
    return curves


def summaries(results: dict[str, Result], pairs: list[ImagePair]) -> dict[str, dict[str, dict[str, float]]]:
    """Group of pairs -> estimator -> recall and AUC@0.05 in percent, milliseconds (median, mean)."""
    by_group: dict[str, dict[str, dict[str, float]]] = {}
    for group, inside in groups(pairs).items():
        by_group[group] = {}
        for spec, result in results.items():
            nsgd, ms = result["nsgd"][:, inside], result["ms"][:, inside]
            own = {name: PERCENT * float(values(nsgd).mean()) for name, values in MERITS.items()}
            by_group[group][spec] = own | {"ms_median": float(np.median(ms)), "ms_mean": float(ms.mean())}
    return by_group


def knee(curve: Curve, figures: dict[str, dict[str, dict[str, float]]]) -> str:
    """The cheapest estimator within KNEE_TOLERANCE of the best AUC@0.05, averaged over the families."""
    families = [group for group in figures if group != "all" and not group.endswith("baselines")]
    area = {spec: float(np.mean([figures[family][spec]["auc_05"] for family in families])) for spec in curve.specs}
    cost = {spec: float(np.mean([figures[family][spec]["ms_mean"] for family in families])) for spec in curve.specs}
    good = [spec for spec in curve.specs if area[spec] >= max(area.values()) - KNEE_TOLERANCE]
    return min(good, key=cost.__getitem__)


def table(
    curves: list[Curve], figures: dict[str, dict[str, dict[str, float]]], knees: dict[str, str], seeds: int
) -> str:
    """A row for each point: time, and recall at 0.05 / at 0.01 / AUC@0.05 of wide and of short baselines."""
    overall = list(figures)[-1]
    shown = [group for group in figures if group.endswith("baselines")] or [overall]
    lines = [
        "Median milliseconds of processor time over all pairs, and R.05 / R.01 / AUC@0.05 in %; "
        f"{seeds} {'seed' if seeds == 1 else 'seeds'}. "
        "The knee of each curve, chosen on tuning data, is in bold.",
        "",
        f"| | | ms | {' | '.join(shown)} |",
        f"| --- | ---: | ---: |{' ---: |' * len(shown)}",
    ]
    for curve in curves:
        for i, (spec, value) in enumerate(zip(curve.specs, curve.values, strict=True)):
            cells = [value, f"{figures[overall][spec]['ms_median']:.1f}"]
            cells += [" / ".join(f"{figures[group][spec][name]:.1f}" for name in MERITS) for group in shown]
            if knees.get(curve.name) == spec:
                cells = [f"**{cell}**" for cell in cells]
            lines.append(f"| {' | '.join([curve.name if i == 0 else '', *cells])} |")
    return "\n".join(lines)
