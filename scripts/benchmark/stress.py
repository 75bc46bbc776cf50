"""Where estimators fail: sweeps of inlier ratio, noise and number of matches, and conditions that hurt.

python -m scripts.benchmark stress --root DATA/Strecha --root DATA/PhotoTourism --root DATA/KITTI --root DATA/TUM \
    --rendered full --rows stress.jsonl --table docs/tables/stress.csv --figures docs/benchmarks
"""

import argparse
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.data import ImagePair
from fmtorch.evaluation.run import select
from fmtorch.pipeline.pipeline import Outcome
from fmtorch.presets.composition import WIDE
from fmtorch.scenes.dataset import FAMILIES
from scripts.benchmark import pairs, tables
from scripts.benchmark.changes import CONDITIONED, MIN_RIGHT, SWEEPS, Case, Change, Level, case_of, on_plane, parallax
from scripts.benchmark.methods import method, read_specs
from scripts.benchmark.runner import Item, Kept, Row, add_command, measure
from scripts.benchmark.tables import Record, Results, Sheet, show

SPECS = Path(__file__).with_name("stress.txt")
AXES = {"inlier ratio": "inlier ratio", "noise": "added noise [px]", "match count": "matches"}
IMAGES = 256  # whose features are kept, some 5 MB each
PLANE, TURN = 0.8, 0.02
NATURAL: dict[Level, Callable[[Row], bool]] = {
    "of these: one homography": lambda row: row["plane"] > PLANE and not row["parallax"] < TURN * row["side"],
    "of these: rotation": lambda row: row["plane"] > PLANE and row["parallax"] < TURN * row["side"],
}
"""Unchanged pairs of which one homography explains nearly all right matches; the second, with next to no parallax."""


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "stress", run, __doc__, seeds=1)
    pairs.add_set_options(parser, limit=20)  # of rendered families half as many
    parser.add_argument("--specs", type=Path, default=SPECS, help="estimators; those in (...) for conditions only")
    parser.add_argument("--only", nargs="*", default=list(SWEEPS), choices=list(SWEEPS), help="all by default")
    parser.add_argument("--figures", type=Path, help="draw stress_SWEEP.svg into this folder")


def run(arguments: argparse.Namespace) -> None:
    def measured_rows(kept: Kept) -> list[Row]:
        conditioned = functools.partial(dataclasses.replace, takes=lambda item: item.facts["sweep"] == CONDITIONED)
        methods = [
            conditioned(method(spec.strip("()"))) if spec.startswith("(") else method(spec)
            for spec in read_specs(arguments.specs)
        ]
        return measure(methods, items_of(arguments), arguments.seeds, kept)

    rows = pairs.rows_of(arguments, measured_rows)
    show([accuracy_sheet(rows), time_sheet(rows)], arguments.table)
    for sweep in {row["sweep"] for row in rows} & AXES.keys() if arguments.figures else ():
        draw(rows, sweep, arguments.figures / f"stress_{sweep.replace(' ', '_')}.svg")


def items_of(arguments: argparse.Namespace) -> Iterator[Item]:
    """The pairs that are asked for, families in turn, with the SIFT matches that pass the ratio test, changed."""
    families: dict[str, list[ImagePair]] = {}
    for dataset in pairs.sets_of(arguments):
        limit = (arguments.limit + 1) // 2 if dataset.name == "rendered" else arguments.limit
        for pair in select([dataset[i] for i in range(len(dataset))], limit):
            families.setdefault(pair.family, []).append(pair)
    front = pairs.front_of("sift", [], memory=IMAGES)

    def case_or_none(pair: ImagePair) -> Case | None:
        c = front.correspondences([pair])[0].correspondences
        case = None if c is None else case_of(pair, c)
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


def families_of(results: Results) -> dict[str, list[str]]:
    """The pairs that all methods have, by `group`."""
    return {name: own for name, own in results.groups(results.pairs()).items() if name in results.families}


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
        lines = results.records(families_of(results), ("R.05", "R.01", "AUC@0.05"), "estimator", ["AUC@0.05"])
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


def draw(rows: Sequence[Row], sweep: str, path: Path) -> None:
    """AUC@0.05 against the level, a panel for each set."""
    panels: dict[str, dict[str, tables.Line]] = {}
    for _, level, results in (each for each in by_level(rows) if each[0] == sweep):
        for (name, own), estimator in itertools.product(families_of(results).items(), results.methods):
            line = panels.setdefault(name, {}).setdefault(estimator, tables.Line([], []))
            line.x.append(float(level))
            line.y.append(results.percent(estimator, own, "AUC@0.05"))
    scale = "linear" if sweep == "noise" else "log"
    tables.draw(path, panels, (AXES[sweep], "AUC@0.05 [%]"), scale, [float(x) for x in SWEEPS[sweep]])
