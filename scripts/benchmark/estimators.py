"""Robust estimators on the same matches, one thread each: recall, AUC@0.05, milliseconds, paired intervals.

An estimator is named as scripts/benchmark/methods.py says; the pruners after @ count into its time. The pruner
`ngransac` is the network of --ngransac; without it, estimators that name it are left out. A row of --rows counts only
for the code, options and learned files that it was made with.
"""

import argparse
import csv
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fmtorch.data import ImagePair
from fmtorch.evaluation.run import select
from fmtorch.pipeline.pipeline import Outcome
from fmtorch.presets.composition import WIDE
from fmtorch.scenes.dataset import FAMILIES
from scripts.benchmark import pairs, tables
from scripts.benchmark.changes import CONDITIONED, MIN_RIGHT, SWEEPS, Case, Change, Level, case_of, on_plane, parallax
from scripts.benchmark.methods import NGRANSAC, method, ngransac, read_specs, specs_of, stages_of
from scripts.benchmark.runner import Item, Kept, Row, add_command, measure
from scripts.benchmark.tables import BASELINES, Record, Results, Sheet, show

FOLDER = Path(__file__).parent
KNEE_TOLERANCE = 0.5  # points of AUC@0.05 below the best of its curve
CURVES = """Accuracy against time: estimators at several values of an option, with the best and the knee of each curve.

The knee of a curve is its cheapest point within 0.5 points of its best AUC@0.05, averaged over the families. It is
chosen on tuning data, and marked on the curves of test data.
"""
STRESS = "Where estimators fail: sweeps of inlier ratio, noise and number of matches, and conditions that hurt."
IMAGES = 256  # whose features are kept, some 5 MB each
PLANE, TURN = 0.8, 0.02
NATURAL: dict[Level, Callable[[Row], bool]] = {
    "of these: one homography": lambda row: row["plane"] > PLANE and not row["parallax"] < TURN * row["side"],
    "of these: rotation": lambda row: row["plane"] > PLANE and row["parallax"] < TURN * row["side"],
}
"""Unchanged pairs of which one homography explains nearly all right matches; the second, with next to no parallax."""


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "estimators", run, __doc__, pairs.add_method_options, seeds=1)
    parser.add_argument("--estimators", nargs="+", default=[], help="PRESET[:KEY=VALUE,...][@PRUNER+PRUNER...]")
    parser.add_argument("--ngransac", type=Path, help="NG-RANSAC's published weights (scripts/convert_checkpoint.py)")
    parser = add_command(commands, "curves", run_curves, CURVES, pairs.add_match_options, seeds=1)
    parser.add_argument("--specs", type=Path, default=FOLDER / "curves.txt", help="lines: CURVE | ESTIMATOR | VALUES")
    parser.add_argument("--curves", nargs="+", default=[], help="such lines, in place of the file")
    parser.add_argument("--knees", type=Path, help="a --table, measured on tuning data, whose knees are marked")
    parser.add_argument("--figure", type=Path, help="draw the curves into this SVG")
    parser = add_command(commands, "stress", run_stress, STRESS, pairs.add_set_options, seeds=1)
    parser.set_defaults(limit=20)  # of rendered families half as many
    parser.add_argument("--specs", type=Path, default=FOLDER / "stress.txt", help="estimators; (...): conditions only")
    parser.add_argument("--only", nargs="*", default=list(SWEEPS), choices=list(SWEEPS), help="all by default")
    parser.add_argument("--figure", type=Path, help="draw the sweep of inlier ratios into this SVG")


def run(arguments: argparse.Namespace) -> None:
    extra = ngransac(arguments.ngransac)
    specs = specs_of(arguments.estimators, arguments.specs) if pairs.named(arguments) else []
    results = measured([spec for spec in specs if extra or NGRANSAC not in stages_of(spec)], arguments, extra)
    show([sheet(results, arguments.shares)], arguments.table)


def measured(specs: Sequence[str], arguments: argparse.Namespace, extra: Mapping[str, Any]) -> Results:
    """These estimators on the pairs that are asked for, or where there are none all rows that are kept."""

    def measured_rows(kept: Kept) -> list[Row]:
        matches = pairs.matches_identity(arguments)
        methods = [method(spec, matches, extra) for spec in specs]
        return measure(methods, pairs.matched(arguments), arguments.seeds, kept)

    return Results(pairs.rows_of(arguments, measured_rows))


def sheet(results: Results, shares: Sequence[float]) -> Sheet:
    """Recall, AUC@0.05, the lead of the first estimator over each, and times, of each set."""
    merits = ("R.05", "R.01", "AUC@0.05")
    groups = results.groups(results.pairs(), shares)
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
        lines = csv.DictReader(arguments.knees.read_text(encoding="utf-8").splitlines())
        knees |= {line["curve"]: line["estimator"] for line in lines if "knee" in line["mark"]}
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
    families = results.by_family(results.pairs()).values()
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
    panels: dict[str, dict[str, tables.Line]] = {}
    for group, own in _shown(results).items():
        for curve in curves:
            x = [float(np.median(results.get(spec, own)("ms"))) for spec in curve.specs]
            y = [results.percent(spec, own, "AUC@0.05") for spec in curve.specs]
            marked = curve.specs.index(knees[curve.name]) if knees.get(curve.name) in curve.specs else None
            panels.setdefault(group, {})[curve.name] = tables.Line(x, y, marked)
    tables.draw(path, panels, ("ms a pair (median)", "AUC@0.05 [%]"), "log")


# Stress


def run_stress(arguments: argparse.Namespace) -> None:
    def measured_rows(kept: Kept) -> list[Row]:
        conditioned = functools.partial(dataclasses.replace, takes=lambda item: item.facts["sweep"] == CONDITIONED)
        specs = read_specs(arguments.specs)
        methods = [conditioned(method(spec.strip("()"))) if spec[0] == "(" else method(spec) for spec in specs]
        return measure(methods, items_of(arguments), arguments.seeds, kept)

    rows = pairs.rows_of(arguments, measured_rows)
    show([accuracy_sheet(rows), time_sheet(rows)], arguments.table)
    if arguments.figure:
        draw_inlier_ratios(rows, arguments.figure)


def items_of(arguments: argparse.Namespace) -> Iterator[Item]:
    """The pairs that are asked for, families in turn, with the SIFT matches that pass the ratio test, changed."""
    families, depths = dict[str, list[ImagePair]](), dict[str, Any]()
    for dataset in pairs.sets_of(arguments):
        limit = (arguments.limit + 1) // 2 if dataset.name == "rendered" else arguments.limit
        for pair in select([dataset[i] for i in range(len(dataset))], limit):
            families.setdefault(pair.family, []).append(pair)
            depths[pair.identity] = getattr(dataset, "depth", None)
    front = pairs.front_of("sift", [], memory=IMAGES)

    def case_or_none(pair: ImagePair) -> Case | None:
        c = front.correspondences([pair])[0].correspondences
        case = None if c is None else case_of(pair, c)._replace(depth=depths[pair.identity])
        return None if case is None or int(case.right.sum()) < MIN_RIGHT else case

    for turn in itertools.zip_longest(*families.values()):  # an interrupted run has some of each family
        for pair in (pair for pair in turn if pair is not None):
            case = functools.cache(functools.partial(case_or_none, pair))
            for sweep in arguments.only:
                yield from (item_of(pair, case, sweep, level, change) for level, change in SWEEPS[sweep].items())


def item_of(pair: ImagePair, case: Callable[[], Case | None], sweep: str, level: Level, change: Change) -> Item:
    """A pair after a change; of conditions with its share of right matches on a plane and its parallax."""
    facts: Row = {"sweep": sweep, "level": level}

    def make() -> Outcome | None:
        base = case()
        changed = None if base is None else change(base)
        if changed is None:
            return None
        facts.update(matches=len(changed.right), right=int(changed.right.sum()))
        if sweep == CONDITIONED:
            facts["plane"] = round(float(on_plane(changed).sum() / changed.right.sum()), 3)
            facts["parallax"] = round(parallax(changed), 2)
            facts["side"] = float(max(size.max() for size in changed.sizes()))
        return Outcome(changed.pair, (len(changed.right),) * 2, changed.c)

    return Item(pair, make, facts)


def by_level(rows: Sequence[Row]) -> Iterator[tuple[str, Level, Results]]:
    """Each sweep's levels in order, with the rows there of real pairs, wide and short, and of rendered ones."""
    named = [{**row, "method": label(row["method"]), "family": group(row["family"])} for row in rows]
    for sweep, levels in SWEEPS.items():
        for level in (*levels, *(NATURAL if sweep == CONDITIONED else ())):
            shown, holds = ("as they are", NATURAL[level]) if level in NATURAL else (level, bool)
            own = [row for row in named if (row["sweep"], row["level"]) == (sweep, shown) and holds(row)]
            if own:
                yield sweep, level, Results(own)


def group(family: str) -> str:
    return "rendered" if family in FAMILIES else "real, wide" if family in WIDE else "real, short"


def label(spec: str) -> str:
    """An estimator's name in tables: without its stages and the options that all of its kind have."""
    front, _, stages = spec.partition("@")
    name, _, rest = front.partition(":")
    options = [option for option in rest.split(",") if option and not option.startswith(("threshold=", "prosac="))]
    return ", ".join([name, *options, *(["no sizes"] if "sizeless" in stages else [])])


def accuracy_sheet(rows: Sequence[Row]) -> Sheet:
    """Recall and AUC@0.05 of each set at each level, of the pairs that all have, and the lead of the first."""
    records: list[Record] = []
    for sweep, level, results in by_level(rows):
        groups = results.by_family(results.pairs())
        lines = results.records(groups, ("R.05", "R.01", "AUC@0.05"), "estimator", ["AUC@0.05"])
        records += [{"test": sweep, "set": line.pop("set"), "level": level, **line} for line in lines]
    return Sheet("accuracy", "Recall at NSGD 0.05, at 0.01 and AUC@0.05 in %; lead: the first minus this", records)


def time_sheet(rows: Sequence[Row]) -> Sheet:
    """The median number of matches at each level, and median processor milliseconds a pair."""
    records: list[Record] = []
    for sweep, level, results in by_level(rows):
        for name in results.methods:
            matches = np.median(results.get(name, results.pairs())("matches"))
            ms = results.cell(name, results.pairs(), "ms")
            records.append({"test": sweep, "level": level, "estimator": name, "matches": f"{matches:.0f}", "ms": ms})
    return Sheet("times", "Median number of matches, median processor milliseconds a pair", records)


def draw_inlier_ratios(rows: Sequence[Row], path: Path) -> None:
    panels: dict[str, dict[str, tables.Line]] = {}
    for _, level, results in by_level([row for row in rows if row["sweep"] == "inlier ratio"]):
        for (name, own), estimator in itertools.product(results.by_family(results.pairs()).items(), results.methods):
            line = panels.setdefault(name, {}).setdefault(estimator, tables.Line([], []))
            line.x.append(float(level))
            line.y.append(results.percent(estimator, own, "AUC@0.05"))
    tables.draw(path, panels, ("inlier ratio", "AUC@0.05 [%]"), "log", [float(x) for x in SWEEPS["inlier ratio"]])
