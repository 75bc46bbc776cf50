"""Where estimators fail: sweeps of inlier ratio, noise and number of matches, and conditions that hurt.

python -m scripts.benchmark stress --root DATA/Strecha --root DATA/PhotoTourism --root DATA/KITTI --root DATA/TUM \\
    --rendered full --rows stress.jsonl --table docs/tables/stress.csv --figures docs/benchmarks
python -m scripts.benchmark stress --rows stress.jsonl

--rows is appended to pair by pair: started again, the command goes on where it was interrupted, and measures what more
seeds need. A row counts only for the code, options and learned files that it was made with. `sizeless` among an
estimator's stages takes the image sizes away, and with them the prior on cameras.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.data import ImagePair
from fmtorch.data.rendered.generate import FAMILIES
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from scripts.benchmark import figures, pairs
from scripts.benchmark.methods import method, read_specs
from scripts.benchmark.runner import Item, Kept, Method, Row, add_command, measure
from scripts.benchmark.stress_changes import (
    CONDITIONS,
    MIN_RIGHT,
    SWEEPS,
    Case,
    Change,
    case_of,
    on_plane,
    parallax,
)
from scripts.benchmark.tables import FIGURES, Record, Results, Sheet, show

SPECS = Path(__file__).with_name("stress.txt")
CONDITIONED = "conditions"
AXES = {"inlier ratio": "inlier ratio", "noise": "added noise [px]", "match count": "matches"}
IMAGES = 256  # whose features are kept, some 5 MB each
PLANE, TURN = 0.8, 0.02
Level = float | str


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "stress", run, __doc__, seeds=1)
    pairs.add_set_options(parser, limit=20)
    parser.add_argument("--rendered-limit", type=int, default=10, help="pairs of each rendered family at most")
    parser.add_argument("--specs", type=Path, default=SPECS, help="estimators; those in (...) for conditions only")
    parser.add_argument("--only", nargs="*", default=[], choices=[*SWEEPS, CONDITIONED], help="all by default")
    parser.add_argument("--figures", type=Path, help="draw stress_SWEEP.svg into this folder")


def run(arguments: argparse.Namespace) -> None:
    kept = Kept(arguments.rows)
    rows = kept.rows
    if pairs.named(arguments):
        items = (changed_item(case, *change) for case in cases(arguments) for change in changes(arguments.only))
        rows = measure(methods_of(read_specs(arguments.specs)), items, arguments.seeds, kept)
    if not rows:
        raise SystemExit("nothing to show: name sets with --root or --rendered, or a file of earlier --rows")
    show([accuracy_sheet(rows), time_sheet(rows)], arguments.table)
    if arguments.figures:
        for sweep in {row["sweep"] for row in rows} & AXES.keys():
            draw(rows, sweep, arguments.figures / f"stress_{sweep.replace(' ', '_')}.svg")


def methods_of(specs: Sequence[str]) -> list[Method]:
    """The estimators; those in brackets are measured under conditions alone."""
    return [
        dataclasses.replace(method(spec.strip("()")), takes=_under_conditions) if spec.startswith("(") else method(spec)
        for spec in specs
    ]


def _under_conditions(item: Item) -> bool:
    return bool(item.facts["sweep"] == CONDITIONED)


class LazyCase:
    """A pair whose matches are made when something asks for them."""

    def __init__(self, pair: ImagePair, front: Pipeline) -> None:
        self.pair, self._front = pair, front

    @functools.cached_property
    def case(self) -> Case | None:
        """None where there are too few right matches."""
        c = self._front.match([self.pair])[0].correspondences
        case = None if c is None else case_of(self.pair, c)
        return None if case is None or int(case.right.sum()) < MIN_RIGHT else case


def cases(arguments: argparse.Namespace) -> Iterator[LazyCase]:
    """The pairs that are asked for, families in turn, with the SIFT matches that pass the ratio test."""
    families: dict[str, list[ImagePair]] = {}
    for dataset in pairs.sets_of(arguments):
        limit = arguments.rendered_limit if dataset.name == "rendered" else arguments.limit
        for pair in pairs.select([dataset[i] for i in range(len(dataset))], limit):
            families.setdefault(pair.family, []).append(pair)
    front = pairs.front_of("sift", [], memory=IMAGES)
    for turn in itertools.zip_longest(*families.values()):  # an interrupted run has some of each family
        yield from (LazyCase(pair, front) for pair in turn if pair is not None)


def changes(only: Sequence[str]) -> Iterator[tuple[str, Level, Change]]:
    """Sweep, level and what is done to a case, of all that are asked for."""
    for sweep, levels in {**SWEEPS, CONDITIONED: CONDITIONS}.items():
        if not only or sweep in only:
            yield from ((sweep, level, change) for level, change in levels.items())


def changed_item(case: LazyCase, sweep: str, level: Level, change: Change) -> Item:
    """A pair after a change; of conditions with its share of right matches on a plane and its parallax."""
    facts: Row = {"sweep": sweep, "level": level}

    def make() -> Outcome | None:
        changed = None if case.case is None else change(case.case)
        if changed is None:
            return None
        facts.update(matches=len(changed.right), right=int(changed.right.sum()))
        if sweep == CONDITIONED:
            facts["plane"] = round(float(on_plane(changed).sum() / changed.right.sum()), 3)
            facts["parallax"] = round(parallax(changed), 2)
            facts["side"] = float(max(size.max() for size in changed.sizes()))
        return Outcome(changed.pair, (len(changed.right),) * 2, changed.c)

    return Item(case.pair, make, facts)


NATURAL: dict[str, Callable[[Row], bool]] = {
    "of these: one homography": lambda row: row["plane"] > PLANE and not row["parallax"] < TURN * row["side"],
    "of these: rotation": lambda row: row["plane"] > PLANE and row["parallax"] < TURN * row["side"],
}
"""Unchanged pairs of which one homography explains nearly all right matches; the second, with next to no parallax."""


def group(family: str) -> str:
    """Real pairs of wide or of short baselines, or rendered ones."""
    return "rendered" if family in FAMILIES else "real, wide" if pairs.is_wide(family) else "real, short"


def by_level(rows: Sequence[Row]) -> Iterator[tuple[str, Level, Results]]:
    """Each sweep's levels in order, with the rows of the pairs that all estimators have there."""
    for sweep, levels in {**SWEEPS, CONDITIONED: {**CONDITIONS, **NATURAL}}.items():
        own = [{**row, "method": label(row["method"]), "family": group(row["family"])} for row in rows if row["sweep"] == sweep]
        for level in levels:
            shown = "as they are" if level in NATURAL else level
            there = [row for row in own if row["level"] == shown and NATURAL.get(str(level), bool)(row)]
            if there:
                yield sweep, level, Results(there)


def label(spec: str) -> str:
    """An estimator's name in tables: without its stages and the options that all of its kind have."""
    front, _, stages = spec.partition("@")
    name, _, rest = front.partition(":")
    options = [option for option in rest.split(",") if option and not option.startswith(("threshold=", "prosac="))]
    return ", ".join([name, *options, *(["no sizes"] if "sizeless" in stages else [])])


def accuracy_sheet(rows: Sequence[Row]) -> Sheet:
    """Recall and AUC@0.05 of each set at each level, and the lead of the first estimator."""
    records: list[Record] = []
    for sweep, level, results in by_level(rows):
        groups = {name: own for name, own in results.groups(results.pairs()).items() if name in results.families}
        lines = results.records(groups, ("R.05", "R.01", "AUC@0.05"), label="estimator", minus=["AUC@0.05"])
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
    panels: dict[str, dict[str, figures.Line]] = {}
    area = FIGURES["AUC@0.05"]
    for _, level, results in (each for each in by_level(rows) if each[0] == sweep):
        for set_name, own in results.groups(results.pairs()).items():
            for name in results.methods if set_name in results.families else ():
                line = panels.setdefault(set_name, {}).setdefault(name, figures.Line([], []))
                line.x.append(float(level))
                line.y.append(area.scale * float(area.of(results.get(name, own)).mean()))
    scale = "linear" if sweep == "noise" else "log"
    figures.draw(path, panels, AXES[sweep], "AUC@0.05 [%]", xscale=scale, ticks=list(SWEEPS[sweep]))
