"""PoseBench's relative poses (github.com/PoseLib/posebench) by its protocol, beside its published figures.

FILES is the folder `relative` of its data, or one file of it; --root judges pairs in FM-Bench's layout in the same way,
by SIFT matches and --threshold. Of each pair the error is the larger of the angles of rotation and of translation,
whose sign counts; of a fundamental matrix the best of its four poses is taken. Sets of other names need --threshold;
pairs whose cameras have distortion are left out.

python -m scripts.benchmark posebench FILES --every 10 --methods E:fmtorch E:fmtorch:scaled=false E:poselib E:colmap
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import functools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fmtorch import data, metrics, presets
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import DataError, ImagePair
from fmtorch.evaluation.statistics import MIN_UNITS, PERCENT, POSE_THRESHOLDS, difference
from fmtorch.io import h5
from fmtorch.pipeline.pipeline import Outcome
from fmtorch.presets.objects import merged
from scripts.benchmark import pairs
from scripts.benchmark.cameras import has_cameras
from scripts.benchmark.methods import estimate_by_call, split
from scripts.benchmark.runner import Item, Kept, Method, Row, add_command, console, identity, measure
from scripts.benchmark.tables import FIGURES, Record, Results, Sheet, Span, show, span

METHODS = ("E:fmtorch", "E:poselib", "E:colmap", "F:fmtorch", "F:poselib", "F:colmap")
KINDS = ("E", "F")  # a relative pose of known cameras; a fundamental matrix, of whose four poses the best one counts
MAX_ITERATIONS, MIN_ITERATIONS, CONFIDENCE = 1000, 100, 0.9999
FOCAL_SAMPLES = 250  # of a round of our search with focal lengths
IN_PIXELS = ("threshold", "inlier_threshold", "scale")  # options of our presets that are distances
PUBLISHED = Path(__file__).with_name("posebench.csv")  # PoseLib 2.0.5; results/baseline.2_0_5.json there
Published = dict[str, dict[str, dict[str, float]]]  # method -> data set -> column -> per cent


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "posebench", run, __doc__, seeds=1)
    parser.add_argument("files", nargs="?", type=Path, help="the folder `relative` of PoseBench's data, or one file")
    pairs.add_match_options(parser)
    parser.add_argument("--methods", nargs="+", default=METHODS, help="KIND:PRESET[:KEY=VALUE,...], KIND being E or F")
    parser.add_argument("--threshold", type=float, help="px, of sets that are not PoseBench's")
    parser.add_argument("--every", type=int, default=1, help="every so many-th pair of each set; the protocol has all")


def run(arguments: argparse.Namespace) -> None:
    thresholds, published = read_published()
    kept = Kept(arguments.rows)
    rows: list[Row] = []
    for name, threshold, items, digest in sets_of(arguments, thresholds):
        selected = items[:: arguments.every]
        usable = [item for item in selected if item.pair.problem is None]
        for item in usable:
            item.facts["threshold"] = threshold
        methods = [protocol(word, threshold, digest) for word in arguments.methods]
        own = measure(methods, usable, arguments.seeds, kept)
        say_what_is_missing(name, selected, own)
        rows += [{**row, "family": name} for row in own]
    if not rows:
        raise SystemExit("no pair of pinhole cameras")
    show([sheet(rows, thresholds, published)], arguments.table)


Sets = Iterator[tuple[str, float, list[Item], str]]  # name, threshold in pixels, pairs and digest of each


def sets_of(arguments: argparse.Namespace, thresholds: Mapping[str, float]) -> Sets:
    """The sets that are asked for. SystemExit where there are none, or for no threshold."""
    if arguments.files is None and not pairs.named(arguments):
        raise SystemExit("name FILES, the folder `relative` of PoseBench's data, or --root DATA")
    if arguments.files is not None:
        yield from _files(arguments.files, thresholds, arguments.threshold)
    if pairs.named(arguments):
        if arguments.threshold is None:
            raise SystemExit("--root: give the threshold in pixels, --threshold PX")
        families: dict[str, list[Item]] = {}
        for item in pairs.matched(arguments):
            if has_cameras(item.pair):
                families.setdefault(item.pair.family, []).append(item)
        digest = pairs.matches_identity(arguments)
        yield from ((name, arguments.threshold, items, digest) for name, items in families.items())


def _points_alone(outcome: Outcome, seed: int) -> Outcome:
    """A pair as PoseBench has it."""
    c = outcome.correspondences
    plain = None if c is None else Correspondences(c.x0, c.x1, c.mask, size0=c.size0, size1=c.size1, key=c.key)
    return dataclasses.replace(outcome, correspondences=plain)


def _files(folder: Path, thresholds: Mapping[str, float], px: float | None) -> Sets:
    root = folder / "relative" if (folder / "relative").is_dir() else folder
    try:
        paths = [path for path in h5.files(root) if not path.stem.startswith("fisheye_") or path.stem in thresholds]
        for path in paths:
            if (threshold := thresholds.get(path.stem, px)) is None:
                raise SystemExit(f"{path.name} is none of PoseBench's sets: give its threshold in pixels, --threshold")
            dataset = data.load("h5", root=path, layout="posebench")
            items = pairs.items(dataset, pairs.front_of("sift", []))  # which takes the matches that a pair comes with
            yield path.stem, threshold, items, dataset.digest
    except DataError as error:
        raise SystemExit(f"{error}; give the folder `relative` of PoseBench's data") from error


def protocol(text: str, threshold: float, matches: str = "") -> Method:
    """``KIND:PRESET[:KEY=VALUE,...]`` by the protocol at so many pixels. Raises SystemExit for anything else."""
    kind, _, rest = text.partition(":")
    preset, changes = split(rest)
    if kind not in KINDS or preset not in presets.available("estimator"):
        raise SystemExit(f"{text}: write KIND:PRESET[:KEY=VALUE,...], KIND being E or F, PRESET of `fmtorch list`")
    own = options_of(preset, changes, threshold)
    solve = functools.partial(_estimated, kind, {"estimator": preset, **own})
    made_with = identity([("estimator", preset, own)], text, matches)
    return Method(text, made_with, lambda family: {}, solve, view=_points_alone, signed=True)


def _estimated(kind: str, given: dict[str, Any], pair: ImagePair, c: Correspondences, seed: int) -> Estimate:
    try:
        return estimate_by_call(given | ({"K0": pair.K0, "K1": pair.K1} if kind == "E" else {}), c, seed)
    except ValueError as error:
        no, zero = torch.zeros(1, dtype=torch.bool), torch.zeros(1, dtype=torch.int64)
        return Estimate(torch.zeros(1, 3, 3), torch.zeros_like(c.mask), no, (str(error),), zero)


def options_of(name: str, changes: dict[str, Any], threshold: float) -> dict[str, Any]:
    """The options of a preset on a data set whose threshold is so many pixels; changes: replace the protocol's.
    At most 1,000 samples, at least 100, confidence 0.9999. A peer gets the threshold. Our presets, whose distances are
    of matches that are exact to about a pixel, get them times the threshold, unless ``scaled=false``."""
    changes = dict(changes)
    scaled = changes.pop("scaled", True)
    preset = presets.load("estimator", name)
    if "hypotheses" in preset:  # one of ours
        own = _distances(preset, threshold) if scaled else {}
        own |= {"hypotheses": MAX_ITERATIONS, "confidence": CONFIDENCE}
        if preset.get("focal"):
            own["focal"] = {**own.get("focal", {}), "rounds": MAX_ITERATIONS // FOCAL_SAMPLES}
    else:
        known = {"threshold": threshold, "iterations": MAX_ITERATIONS, "min_iterations": MIN_ITERATIONS}
        known |= {"confidence": CONFIDENCE, "two_view": False}
        own = {key: value for key, value in known.items() if key in preset}
    return merged(own, changes)


def _distances(preset: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """The distances within a preset, at any depth, times `scale`."""
    levels = {key: _distances(value, scale) for key, value in preset.items() if isinstance(value, Mapping)}
    own = {key: value * scale for key, value in preset.items() if key in IN_PIXELS and value is not None}
    return {**{key: inside for key, inside in levels.items() if inside}, **own}


def say_what_is_missing(name: str, items: Sequence[Item], rows: Sequence[Row]) -> None:
    """Pairs that are left out, with a reason, and how many a method has no pose for."""
    if problems := [item.pair.problem for item in items if item.pair.problem is not None]:
        console.print(f"{name}: {len(problems)} of {len(items)} pairs left out: {problems[0]}", highlight=False)
    reasons = {row["method"]: row["reason"] for row in reversed(rows) if row["reason"]}
    for method, count in Counter(row["method"] for row in rows if row["reason"]).items():
        console.print(f"{name}, {method}: {count} misses, such as: {reasons[method]}", highlight=False)


def read_published() -> tuple[dict[str, float], Published]:
    """The threshold of each of PoseBench's sets in pixels, and its published figures."""
    figures: Published = {}
    with PUBLISHED.open(encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    for line in lines:
        areas = {f"published: AUC@{t}": float(line[f"auc{t}"]) for t in POSE_THRESHOLDS}
        figures.setdefault(line["method"], {})[line["dataset"]] = areas
    return {line["dataset"]: float(line["threshold"]) for line in lines}, figures


def sheet(rows: Sequence[Row], thresholds: Mapping[str, float], published: Published) -> Sheet:
    """Means over the sets, then each set, with published figures, also of methods that were not run."""
    results = Results(rows)
    sets = {name: own for name, own in results.groups(results.all_pairs).items() if name in results.families}
    theirs = {m: {name: of[name] for name in sets if name in of} for m, of in published.items()}
    methods = [*results.methods, *(m for m, of in theirs.items() if of and m not in results.methods)]
    own_pairs = {m: set(results.pairs(m)) if m in results.methods else set() for m in methods}
    means: list[Record] = []
    of_sets: dict[tuple[str, str], Record] = {}
    for m in methods:
        figures = {name: (areas(results, m, own) if own_pairs[m] else {}) | theirs.get(m, {}).get(name, {})
                   for name, own in sets.items()}  # fmt: skip
        heads = [head for head in next(iter(figures.values())) if all(head in of for of in figures.values())]
        line: Record = {"set": "mean of the sets", "method": m}
        line |= {head: f"{np.mean([of[head] for of in figures.values()]):.1f}" for head in heads}
        line["first of its kind minus this: AUC@5"] = lead(results, sets, m)
        means.append(line | {"ms": results.cell(m, results.pairs(m), "ms") if own_pairs[m] else ""})
        for name, cells in figures.items():
            count = len(own_pairs[m] & set(sets[name])) or ""
            line = {"set": name, "method": m, "px": f"{thresholds.get(name, rows[0]['threshold']):g}", "pairs": count}
            of_sets[name, m] = line | {head: f"{value:.1f}" for head, value in cells.items()}
    records = means + [of_sets[name, m] for name in sets for m in methods]
    title = f"PoseBench's protocol: {len(sets)} sets, {len(set(sets) & set(thresholds))} of its {len(thresholds)}"
    return Sheet("poses", f"{title}; {len(results.all_pairs):,} pairs; signed angles, in %", records)


def areas(results: Results, method: str, own: Sequence[str]) -> dict[str, float]:
    """AUC in per cent at each of the thresholds."""
    get = results.get(method, own)
    worst = torch.from_numpy(np.maximum(get("rotation_error"), get("translation_error")))
    of_seeds = metrics.pose_auc(worst, POSE_THRESHOLDS).mean(0).tolist()
    return {f"AUC@{t}": PERCENT * value for t, value in zip(POSE_THRESHOLDS, of_seeds, strict=True)}


def lead(results: Results, sets: Mapping[str, Sequence[str]], method: str) -> Span | str:
    """AUC@5 of the first method of a kind minus that of another, every set counting alike, with its 95 % interval."""
    first = next((name for name in results.methods if name[0] == method[0]), method)
    if method == first or method not in results.methods:
        return ""
    every = [pair for own in sets.values() for pair in own]
    scenes = results.scenes(every)
    if len(set(scenes)) < MIN_UNITS:
        scenes = every
    share = np.concatenate([np.full(len(own), len(every) / len(sets) / len(own)) for own in sets.values()])
    a, b = (share * FIGURES["pose@5"].of(results.get(name, every)) for name in (first, method))
    return span(difference(a, b, scenes, PERCENT), "+.1f")
