"""Robust estimators on the same matches, one thread each: recall, AUC@0.05, milliseconds, paired intervals.

An estimator is named as PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]; the pruners after @ count into its time, and
`find_fundamental`, `truth`, `ratioless`, `sizeless`, `part` and `bent` are as scripts/benchmark/methods.py says. The
pruner `ngransac` is the network of --ngransac; without it, estimators that name it are left out.

python -m scripts.benchmark estimators --root DATA/Strecha --root DATA/PhotoTourism --seeds 5 --rows rows.jsonl \
    --estimators fmtorch@frame_consistency opencv:method=usac_magsac,threshold=1.0 poselib:threshold=0.5,prosac=true

A row of --rows counts only for the code, options and learned files that it was made with.
"""

import argparse
import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scripts.benchmark import pairs, tables
from scripts.benchmark.methods import NGRANSAC, method, ngransac, read_specs, specs_of, stages_of
from scripts.benchmark.runner import Kept, Row, add_command, measure
from scripts.benchmark.tables import BASELINES, Record, Results, Sheet, show

FOLDER = Path(__file__).parent
KNEE_TOLERANCE = 0.5  # points of AUC@0.05 below the best of its curve
CURVES = """Accuracy against time: estimators at several values of an option, with the best and the knee of each curve.

The knee of a curve is its cheapest point within 0.5 points of its best AUC@0.05, averaged over the families. It is
chosen on tuning data, and marked on the curves of test data.

python -m scripts.benchmark curves --root DATA/Strecha_train --rendered full --split train --limit 60 --table tuning.csv
python -m scripts.benchmark curves --root DATA/Strecha --root DATA/KITTI --knees tuning.csv --figure curves.svg
python -m scripts.benchmark curves --root DATA/castle --curves 'PoseLib | poselib:threshold={} | 0.35 0.5 0.75 1'
"""


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "estimators", run, __doc__, seeds=1)
    pairs.add_match_options(parser)
    parser.add_argument("--estimators", nargs="+", default=[], help="PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]")
    parser.add_argument("--specs", type=Path, help="a file with one estimator a line; # starts a comment")
    parser.add_argument("--ngransac", type=Path, help="NG-RANSAC's published weights (scripts/make_models.py ngransac)")
    parser = add_command(commands, "curves", run_curves, CURVES, seeds=1)
    pairs.add_match_options(parser)
    parser.add_argument("--specs", type=Path, default=FOLDER / "curves.txt", help="lines: CURVE | ESTIMATOR | VALUES")
    parser.add_argument("--curves", nargs="+", default=[], help="such lines, in place of the file")
    parser.add_argument("--knees", type=Path, help="a --table, measured on tuning data, whose knees are marked")
    parser.add_argument("--figure", type=Path, help="draw the curves into this SVG")


def run(arguments: argparse.Namespace) -> None:
    extra = ngransac(arguments.ngransac)
    specs = specs_of(arguments.estimators, arguments.specs) if pairs.named(arguments) else []
    results = measured([spec for spec in specs if extra or NGRANSAC not in stages_of(spec)], arguments, extra)
    show([sheet(results)], arguments.table)


def measured(specs: Sequence[str], arguments: argparse.Namespace, extra: Mapping[str, Any]) -> Results:
    """These estimators on the pairs that are asked for, or where there are none all rows that are kept."""

    def measured_rows(kept: Kept) -> list[Row]:
        matches = pairs.matches_identity(arguments)
        methods = [method(spec, matches, extra) for spec in specs]
        return measure(methods, pairs.matched(arguments), arguments.seeds, kept)

    return Results(pairs.rows_of(arguments, measured_rows))


def sheet(results: Results) -> Sheet:
    """Recall, AUC@0.05, the lead of the first estimator over each, and times, of each set."""
    merits = ("R.05", "R.01", "AUC@0.05")
    groups = results.groups(results.pairs())
    records = results.records(groups, (*merits, "ms", "time ratio"), "estimator", merits[1:])
    seeds, first = min(results.seeds(name) for name in results.methods), results.methods[0]
    title = f"Recall at NSGD 0.05, at 0.01 and AUC@0.05 in %, mean of {seeds} seeds; lead: {first} minus this"
    return Sheet("recall", f"{title}; {results.described(results.pairs())}", records)


Figures = Mapping[str, tuple[float, float]]  # of estimators, by `area_and_cost`


class Curve(NamedTuple):
    """The estimators along a curve, and what is varied between them."""

    name: str
    specs: tuple[str, ...]
    values: tuple[str, ...]


def run_curves(arguments: argparse.Namespace) -> None:
    curves = read_curves(arguments.curves or read_specs(arguments.specs))
    specs = list(dict.fromkeys(spec for curve in curves for spec in curve.specs))
    results = measured(specs, arguments, {})
    figures = {spec: area_and_cost(results, spec) for spec in specs}
    knees = {curve.name: knee({spec: figures[spec] for spec in curve.specs}) for curve in curves}
    if arguments.knees:
        with arguments.knees.open(encoding="utf-8") as file:
            knees |= {line["curve"]: line["estimator"] for line in csv.DictReader(file) if "knee" in line["mark"]}
    show([curve_sheet(curves, results, figures, knees)], arguments.table)
    if arguments.figure:
        draw_curves(curves, results, knees, arguments.figure)


def read_curves(lines: Sequence[str]) -> list[Curve]:
    """The curves of ``CURVE | ESTIMATOR | VALUES``. Raises SystemExit for a line of another form, naming it."""
    curves = []
    for text in lines:
        parts = [part.strip() for part in text.split("|")]
        if len(parts) != 3 or "{}" not in parts[1] or not parts[2]:
            raise SystemExit(f"{text!r} is not CURVE | ESTIMATOR with {{}} | VALUES")
        values = tuple(parts[2].split())
        curves.append(Curve(parts[0], tuple(parts[1].replace("{}", value) for value in values), values))
    return curves


def area_and_cost(results: Results, spec: str) -> tuple[float, float]:
    """AUC@0.05 in percent and milliseconds, averaged over the families."""
    groups = results.groups(results.pairs())
    families = [groups[family] for family in results.families]
    area = np.mean([results.percent(spec, own, "AUC@0.05") for own in families])
    return float(area), float(np.mean([results.get(spec, own)("ms").mean() for own in families]))


def knee(figures: Figures) -> str:
    """The cheapest estimator of a curve within KNEE_TOLERANCE of its best."""
    best = max(area for area, _ in figures.values())
    return min((cost, spec) for spec, (area, cost) in figures.items() if area >= best - KNEE_TOLERANCE)[1]


def _shown(results: Results) -> dict[str, list[str]]:
    """Wide and short baselines, or all pairs where there is one kind alone."""
    groups = results.groups(results.pairs())
    return {name: groups[name] for name in BASELINES if name in groups} or {list(groups)[-1]: results.pairs()}


def curve_sheet(curves: Sequence[Curve], results: Results, figures: Figures, knees: Mapping[str, str]) -> Sheet:
    """A line for each point: time, and recall at 0.05, at 0.01 and AUC@0.05 of wide and of short baselines."""
    records: list[Record] = []
    for curve in curves:
        best = max(figures[spec][0] for spec in curve.specs)
        for spec, value in zip(curve.specs, curve.values, strict=True):
            marks = ["best"] * (figures[spec][0] == best) + ["knee"] * (knees.get(curve.name) == spec)
            line = {"curve": curve.name, "value": value, "ms": results.cell(spec, results.pairs(), "ms")}
            for group, own in _shown(results).items():
                line |= {f"{group}: {name}": results.cell(spec, own, name) for name in ("R.05", "R.01", "AUC@0.05")}
            line |= {"AUC@0.05 of families": f"{figures[spec][0]:.1f}", "mark": " ".join(marks), "estimator": spec}
            records.append(line)
    return Sheet("curves", f"Accuracy in % against time: {results.described(results.pairs())}", records)


def draw_curves(curves: Sequence[Curve], results: Results, knees: Mapping[str, str], path: Path) -> None:
    """AUC@0.05 against milliseconds, a panel for wide and one for short baselines."""
    panels: dict[str, dict[str, tables.Line]] = {}
    for group, own in _shown(results).items():
        for curve in curves:
            x = [float(np.median(results.get(spec, own)("ms"))) for spec in curve.specs]
            y = [results.percent(spec, own, "AUC@0.05") for spec in curve.specs]
            marked = curve.specs.index(knees[curve.name]) if knees.get(curve.name) in curve.specs else None
            panels.setdefault(group, {})[curve.name] = tables.Line(x, y, marked)
    tables.draw(path, panels, ("ms a pair (median)", "AUC@0.05 [%]"), "log")
