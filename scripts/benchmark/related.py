"""The verdict on pairs of one scene and of different scenes: shares accepted and rejected, and ROC.

python -m scripts.benchmark related --root DATA/Strecha --root DATA/PhotoTourism --root DATA/KITTI --root DATA/TUM \
    --rows related.jsonl --table docs/tables/related.csv --figure docs/concepts/related.svg
"""

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.core.types import RELATED
from fmtorch.evaluation.statistics import share_interval
from scripts.benchmark import pairs, tables
from scripts.benchmark.pipelines import add_pipeline_options, measured, settings_of
from scripts.benchmark.runner import Kept, Row, add_command
from scripts.benchmark.tables import Record, Sheet, Span, show

RIGHT = 0.05  # NSGD below which an estimate of a related pair is right
LEVELS = (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 5.0, 8.0)
Rows = dict[str, list[Row]]  # by pipeline


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "related", run, __doc__, seeds=1)
    pairs.add_set_options(parser)
    parser.add_argument("--unrelated", type=int, default=300, help="pairs of each two scenes at most, chosen by hash")
    add_pipeline_options(parser)
    parser.add_argument("--figure", type=Path, help="draw the ROC curves here, as SVG")
    parser.set_defaults(asift_limit=None)


def run(arguments: argparse.Namespace) -> None:
    def measured_rows(kept: Kept) -> list[Row]:
        related = [pair for pair in pairs.pairs_of(arguments) if pair.problem is None]
        unrelated = pairs.unrelated_pairs(related, pairs.sets_of(arguments), arguments.unrelated)
        every = sorted([*related, *unrelated], key=lambda p: (p.family, p.scene, p.image0.identity, p.image1.identity))
        return measured(settings_of("related")["methods"], every, arguments, kept)

    newest = {(row["method"], row["pair"]): row for row in pairs.rows_of(arguments, measured_rows)}
    names = dict.fromkeys(method for method, _ in newest)
    rows = {name: [row for row in newest.values() if row["method"] == name] for name in names}
    show([rates_sheet(rows), levels_sheet(rows), sets_sheet(rows)], arguments.table)
    if arguments.figure:
        draw(rows, arguments.figure)


def true(row: Row) -> bool:
    return not row["family"].startswith(pairs.UNRELATED)


def right(row: Row) -> bool:
    return true(row) and bool(row["nsgd"] < RIGHT)


def significance(row: Row) -> float:
    """How far the support of a pair's F is beyond chance; least where there is no F."""
    return -math.inf if row["significance"] is None else float(row["significance"])


def inliers(row: Row) -> float:
    """The number of inliers of a pair, 0 where there is no F."""
    return float(row["corrs"] * row["ok"])


def called_related(row: Row) -> bool:
    return significance(row) >= RELATED


RULES: dict[str, Callable[[Row], bool]] = {
    "COLMAP's rule": lambda row: inliers(row) >= max(15, 0.25 * row["corrs_before"]),
    "15 inliers": lambda row: inliers(row) >= 15,
    "20 inliers": lambda row: inliers(row) >= 20,
}
"""What others accept a pair by. COLMAP's default: 15 inliers that are a quarter of the matches."""


def split(rows: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    return [row for row in rows if not true(row)], [row for row in rows if right(row)]


def rates_sheet(rows: Rows) -> Sheet:
    """Each rule: the share of unrelated pairs that it accepts, and of right estimates that it rejects."""
    records: list[Record] = []
    for name, own in rows.items():
        unrelated, good = split(own)
        line: Record = {"pipeline": name, "unrelated pairs": len(unrelated), "right pairs": len(good)}
        line["unrelated pairs with an F, %"] = percent([bool(row["ok"]) for row in unrelated])
        line["accepted, %"] = share(unrelated, called_related)
        line["rejected, %"] = share(good, lambda row: not called_related(row))
        for rule, accepts in RULES.items():
            line[f"{rule}: accepted, %"] = percent([accepts(row) for row in unrelated])
            line[f"{rule}: rejected, %"] = percent([not accepts(row) for row in good])
        for head, figure in (("area", significance), ("area by inliers", inliers)):
            line[head] = f"{tables.chance_of_more(*([figure(row) for row in part] for part in (good, unrelated))):.5f}"
        records.append(line)
    title = f"At level {RELATED:g}: unrelated pairs accepted and right ones (NSGD < {RIGHT}) rejected"
    return Sheet("rates", title, records)


def levels_sheet(rows: Rows) -> Sheet:
    """Points of the ROC curve: unrelated pairs accepted and right ones rejected at several levels."""
    records: list[Record] = []
    for name, own in rows.items():
        unrelated, good = ([significance(row) for row in part] for part in split(own))
        for level in LEVELS:
            accepted, rejected = percent([x >= level for x in unrelated]), percent([x < level for x in good])
            records.append({"pipeline": name, "level": f"{level:g}", "accepted, %": accepted, "rejected, %": rejected})
    return Sheet("levels", "Points of the ROC curves", records)


def sets_sheet(rows: Rows) -> Sheet:
    """By set: pairs called related, of those whose estimate is right and of others."""
    records: list[Record] = []
    for family in sorted({row["family"] for own in rows.values() for row in own}):
        for name, own in rows.items():
            line: Record = {"set": family, "pipeline": name}
            for head, kind in (("right", True), ("other", False)):
                called = [called_related(row) for row in own if row["family"] == family and right(row) == kind]
                line |= {f"{head} pairs": len(called), f"{head} pairs called related": sum(called)}
            records.append(line)
    return Sheet("sets", "Pairs called related", records)


def share(rows: Sequence[Row], holds: Callable[[Row], bool]) -> Span | str:
    """The share of pairs for which something holds, in %, with its interval."""
    if not rows:
        return ""
    i = share_interval(np.array([holds(row) for row in rows]), [f"{row['family']}/{row['scene']}" for row in rows])
    return Span(*(f"{100 * value:.2f}" for value in (i.value, i.low, i.high)))


def percent(values: Sequence[bool]) -> str:
    return f"{100 * np.mean(values):.2f}" if values else ""


def draw(rows: Rows, path: Path) -> None:
    """The ROC curves: a panel for each way to judge pairs, a line for each pipeline, a dot at the verdict's level."""
    panels: dict[str, dict[str, tables.Line]] = {"by significance": {}, "by the number of inliers": {}}
    for name, own in ((name, own) for name, own in rows.items() if all(split(own))):
        for figure, lines in zip((significance, inliers), panels.values(), strict=True):
            unrelated, good = (np.array([figure(row) for row in part], np.float64) for part in split(own))
            levels = np.append(np.unique(np.concatenate([unrelated, good])), np.inf)
            accepted, rejected = (unrelated >= levels[:, None]).mean(1), (good < levels[:, None]).mean(1)
            perfect = " (along the axes)" if ((accepted == 0) & (rejected == 0)).any() else ""
            dot = int(np.searchsorted(levels, RELATED)) if figure is significance else None
            lines[name + perfect] = tables.Line((100 * accepted).tolist(), (100 * rejected).tolist(), dot)
    tables.draw(path, panels, ("unrelated pairs accepted, %", "right pairs rejected, %"), "shares")
