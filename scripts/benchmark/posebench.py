"""PoseBench's relative poses (github.com/PoseLib/posebench) by its protocol, beside its published figures.

FILES is the folder `relative` of its data, or one file of it; --root judges pairs in FM-Bench's layout in the same way,
by SIFT matches and --threshold. Of each pair the error is the larger of the angles of rotation and of translation,
whose sign counts; of a fundamental matrix the best of its four poses is taken. AUC at 5, 10 and 20 degrees, and means
over the sets; intervals of differences are over scenes, or over pairs of fewer than ten. Each set has its threshold;
at most 1,000 samples, at least 100. Sets of other names need --threshold; pairs whose cameras have distortion
(fisheye_*) are left out and counted.

python -m scripts.benchmark posebench FILES
python -m scripts.benchmark posebench --root DATA/Strecha --root DATA/KITTI --threshold 1
python -m scripts.benchmark posebench FILES --every 10 --methods E:fmtorch E:fmtorch:scaled=false E:poselib E:colmap

--rows is appended to pair by pair: started again, the command measures what is missing.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import track

from fmtorch import metrics, presets
from fmtorch.data import DataError, ImagePair
from fmtorch.evaluation.statistics import MIN_UNITS, PERCENT, difference
from scripts.benchmark import matched, sheet
from scripts.benchmark import posebench_methods as methods_of
from scripts.benchmark.kept import Kept, Row
from scripts.benchmark.matched import console
from scripts.benchmark.posebench_sets import THRESHOLDS, Figures, Set, read_published, sets_of
from scripts.benchmark.sheet import MISSING, Sheet, put

METHODS = ("E:fmtorch", "E:poselib", "E:colmap", "F:fmtorch", "F:poselib", "F:colmap")
MISSED = {"rotation": 180.0, "translation": 180.0}


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("posebench", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="?", type=Path, help="the folder `relative` of PoseBench's data, or one file")
    matched.add_arguments(parser)
    parser.add_argument("--methods", nargs="+", default=METHODS, help="KIND:PRESET[:KEY=VALUE,...], KIND being E or F")
    parser.add_argument("--threshold", type=float, help="px, of sets that are not PoseBench's")
    parser.add_argument("--every", type=int, default=1, help="every so many-th pair of each set; the protocol has all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rows", type=Path, help="keep what each method makes of each pair here, one line each")
    parser.add_argument("--markdown", type=Path, help="put the tables between the marks `posebench` of this file")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    published = read_published()
    arguments.methods = installed(arguments.methods)
    rows: dict[str, list[Row]] = {}
    kept = Kept(arguments.rows)
    for each in sets_of(arguments, published[0]):
        set_rows = measured(each, arguments, kept)
        if set_rows:
            rows[each.name] = set_rows
    if not rows:
        raise SystemExit("no pair of pinhole cameras")
    tables = sheets(rows, arguments.methods, published)
    for table in tables:
        console.print(table.terminal())
    if arguments.markdown is not None:
        put(arguments.markdown, tables, "posebench")


def installed(methods: Sequence[str]) -> list[str]:
    """The methods whose packages are there; of those that are named, all must be. Raises SystemExit for another."""
    available = []
    for text in methods:
        try:
            presets.build("estimator", methods_of.read(text).preset)
            available.append(text)
        except ImportError as error:
            if methods is not METHODS:
                raise SystemExit(f"{text}: {error}") from error
            console.print(f"{text} is left out: {error}", style="dim", highlight=False, markup=False)
    return available


def measured(of: Set, arguments: argparse.Namespace, kept: Kept) -> list[Row]:
    """The rows of a set's pairs by all methods."""
    pairs = of.pairs[:: arguments.every]
    usable = [pair for pair in pairs if pair.problem is None]
    done = kept.by("pair", "seed", "threshold", "method", "identity", "matches")
    made_with = {text: (text, methods_of.identity(text), of.digest) for text in arguments.methods}
    rows: list[Row] = []
    for pair in track(usable, of.name, console=console, transient=True):
        new = []
        for text in arguments.methods:
            row = done.get((pair.identity, arguments.seed, of.threshold, *made_with[text]))
            if row is None:
                row = judged(methods_of.read(text), pair, of.threshold, arguments.seed)
                row |= dict(zip(("method", "identity", "matches"), made_with[text], strict=True))
                new.append(row)
            rows.append({**row, "scene": f"{of.name}/{pair.scene}"})
        kept.add(new)
    _say_what_is_missing(of, pairs, rows)
    return rows


def judged(method: methods_of.Method, pair: ImagePair, threshold: float, seed: int) -> Row:
    """What one method makes of a pair: angles in degrees, 180 where it has no pose, and milliseconds."""
    row: Row = {"pair": pair.identity, "seed": seed, "threshold": threshold, "ms": 0.0, "reason": "", **MISSED}
    assert pair.matches is not None
    start = time.process_time()
    try:
        c = pair.matches().correspondences
        start = time.process_time()
        estimate = methods_of.estimated(method, pair, c, threshold, seed)
    except (ValueError, DataError) as error:
        return row | {"reason": str(error), "ms": 1e3 * (time.process_time() - start)}
    row["ms"] = 1e3 * (time.process_time() - start)
    if not bool(estimate.ok[0]):
        return row | {"reason": estimate.reason[0]}
    angles = methods_of.error(method, estimate, pair)
    return row | {"rotation": float(angles.rotation), "translation": float(angles.translation)}


def _say_what_is_missing(of: Set, pairs: Sequence[ImagePair], rows: list[Row]) -> None:
    """Pairs that are left out, with the commonest reason, and those that a method has no pose for."""
    reasons = Counter(pair.problem for pair in pairs if pair.problem is not None)
    if reasons:
        left, (reason, _) = sum(reasons.values()), reasons.most_common(1)[0]
        console.print(f"{of.name}: {left} of {len(pairs)} pairs left out: {reason}", style="dim", highlight=False)
    failed = Counter(row["method"] for row in rows if row["reason"])
    for method, count in failed.items():
        reason = next(row["reason"] for row in rows if row["method"] == method and row["reason"])
        console.print(f"{of.name}, {method}: {count} misses, such as: {reason}", style="dim", highlight=False)


def sheets(
    rows: dict[str, list[Row]], methods: Sequence[str], published: tuple[dict[str, float], Figures]
) -> tuple[Sheet, Sheet]:
    """Means over the sets, and the figures of each set, with published ones, also of methods that were not run."""
    thresholds, theirs = published
    own = {m: {name: [row for row in of if row["method"] == m] for name, of in rows.items()} for m in methods}
    known = [name for name in rows if name in thresholds]
    others = [method for method in theirs if method not in methods and known]
    overall, each = [], []
    for method in (*methods, *others):
        of_sets = own.get(method, {})
        ours = mean([areas(of) for of in of_sets.values()]) if of_sets else None
        said = mean([theirs[method][name] for name in rows]) if method in theirs and len(known) == len(rows) else None
        ms = f"{np.median([row['ms'] for of in of_sets.values() for row in of]):.1f}" if of_sets else MISSING
        overall.append([method, shown(ours), shown(said), lead(own, method), ms])
    for name in rows:
        px = f"{rows[name][0]['threshold']:g}"
        for method in (*methods, *(others if name in known else ())):
            of = own.get(method, {}).get(name)
            stated = shown(theirs.get(method, {}).get(name))
            each.append([name, method, px, *([str(len(of)), shown(areas(of))] if of else [MISSING] * 2), stated])
    count = sum(len(of) for of in own[methods[0]].values())
    part = f", {len(known)} of PoseBench's {len(thresholds)}" if known else ""
    title = f"PoseBench's protocol: means of {len(rows)} set{'s' * (len(rows) != 1)}{part}; {count:,} pairs"
    heading = "AUC@5/10/20°, signed"
    return (
        Sheet(title, ["method", heading, "published", "first of its kind minus this, @5°", "ms, median"], overall),
        Sheet("Each set", ["set", "method", "px", "pairs", heading, "published"], each),
    )


def lead(own: dict[str, dict[str, list[Row]]], method: str) -> str:
    """AUC@5 of the first method of a kind minus that of another, every set counting alike, with its 95 % interval."""
    first = next((name for name in own if name[0] == method[0]), method)
    if method == first or method not in own:
        return ""
    scenes = [row["scene"] for of in own[method].values() for row in of]
    if len(set(scenes)) < MIN_UNITS:
        scenes = [str(i) for i in range(len(scenes))]
    share = np.concatenate([np.full(len(of), len(scenes) / len(own[method]) / len(of)) for of in own[method].values()])
    a, b = (share * np.array([_below(row) for of in own[name].values() for row in of]) for name in (first, method))
    return sheet.shown(difference(a, b, scenes, PERCENT), "+.1f")


def _below(row: Row) -> float:
    """The share of thresholds up to 5 degrees above the error."""
    error: float = max(row["rotation"], row["translation"])
    return max(0.0, 1 - error / THRESHOLDS[0])


def areas(rows: list[Row]) -> tuple[float, ...]:
    """AUC in per cent at each of the thresholds."""
    worst = torch.tensor([max(row["rotation"], row["translation"]) for row in rows], dtype=torch.float64)
    return tuple((100 * metrics.pose_auc(worst, THRESHOLDS)).tolist())


def mean(figures: list[tuple[float, ...]]) -> tuple[float, ...]:
    return tuple(np.mean(figures, 0).tolist())


def shown(figures: tuple[float, ...] | None) -> str:
    return MISSING if figures is None else " / ".join(f"{value:.1f}" for value in figures)
