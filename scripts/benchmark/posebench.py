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
import csv
import dataclasses
import functools
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

import fmtorch
from fmtorch import data, metrics, presets
from fmtorch.data import DataError, ImagePair
from fmtorch.evaluation.intervals import MIN_UNITS
from fmtorch.evaluation.statistics import PERCENT, POSE_THRESHOLDS, difference
from fmtorch.pipeline.pipeline import Outcome
from fmtorch.presets.objects import merged
from fmtorch.storage.exchange import h5
from scripts.benchmark import pairs
from scripts.benchmark.cameras import has_cameras
from scripts.benchmark.methods import options
from scripts.benchmark.runner import Item, Kept, Row, add_command, console, identity, judged, measure
from scripts.benchmark.tables import Record, Sheet, Span, show, span

METHODS = ("E:fmtorch", "E:poselib", "E:colmap", "F:fmtorch", "F:poselib", "F:colmap")
KINDS = ("E", "F")  # a relative pose of known cameras; a fundamental matrix, of whose four poses the best one counts
MAX_ITERATIONS, MIN_ITERATIONS, CONFIDENCE = 1000, 100, 0.9999
FOCAL_SAMPLES = 250  # of a round of our search with focal lengths
IN_PIXELS = ("threshold", "inlier_threshold", "scale")  # options of our presets that are distances
NOT_SCALED = "scaled"  # false: our preset keeps its own distances
PUBLISHED = Path(__file__).with_name("posebench.csv")  # PoseLib 2.0.5; results/baseline.2_0_5.json there
Figures = dict[str, dict[str, tuple[float, ...]]]  # method -> data set -> AUC in per cent


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "posebench", run, __doc__, seeds=1)
    parser.add_argument("files", nargs="?", type=Path, help="the folder `relative` of PoseBench's data, or one file")
    pairs.add_match_options(parser)
    parser.add_argument("--methods", nargs="+", default=METHODS, help="KIND:PRESET[:KEY=VALUE,...], KIND being E or F")
    parser.add_argument("--threshold", type=float, help="px, of sets that are not PoseBench's")
    parser.add_argument("--every", type=int, default=1, help="every so many-th pair of each set; the protocol has all")


def run(arguments: argparse.Namespace) -> None:
    published = read_published()
    methods = installed(arguments.methods)
    kept = Kept(arguments.rows)
    rows: dict[str, list[Row]] = {}
    for of in sets_of(arguments, published[0]):
        items = of.items[:: arguments.every]
        usable = [item for item in items if item.pair.problem is None]
        own = measure([dataclasses.replace(each, matches=of.digest) for each in methods], usable, arguments.seeds, kept)
        _say_what_is_missing(of.name, items, own)
        if own:
            rows[of.name] = [{**row, "scene": f"{of.name}/{row['scene']}"} for row in own]
    if not rows:
        raise SystemExit("no pair of pinhole cameras")
    show([sheet(rows, [method.name for method in methods], published)], arguments.table)


class Set(NamedTuple):
    """Pairs with given matches. digest: of the matches."""

    name: str
    items: Sequence[Item]
    digest: str


def sets_of(arguments: argparse.Namespace, thresholds: Mapping[str, float]) -> Iterator[Set]:
    """The sets that are asked for. Raises SystemExit where there are none, or one has no threshold."""
    if arguments.files is None and not pairs.named(arguments):
        raise SystemExit("name FILES, the folder `relative` of PoseBench's data, or --root DATA")
    if arguments.files is not None:
        yield from _files(arguments.files, thresholds, arguments.threshold)
    if pairs.named(arguments):
        if arguments.threshold is None:
            raise SystemExit("--root: give the threshold in pixels, --threshold PX")
        facts = {"threshold": arguments.threshold}
        families: dict[str, list[Item]] = {}
        for item in pairs.matched(arguments):
            if has_cameras(item.pair):  # by their families, with points alone, as PoseBench has them
                own = Item(item.pair, functools.partial(_points_of, item), facts)
                families.setdefault(item.pair.family, []).append(own)
        digest = pairs.matches_identity(arguments)
        yield from (Set(name, items, digest) for name, items in families.items())


def _points_of(item: Item) -> Outcome | None:
    if item.outcome is None or item.outcome.correspondences is None:
        return item.outcome
    return dataclasses.replace(item.outcome, correspondences=pairs.points_alone(item.matches).correspondences)


def _files(folder: Path, thresholds: Mapping[str, float], threshold: float | None) -> Iterator[Set]:
    root = folder / "relative" if (folder / "relative").is_dir() else folder
    try:
        given = {path: thresholds.get(path.stem, threshold) for path in h5.files(root)}
    except DataError as error:
        raise SystemExit(f"{error}; give the folder `relative` of PoseBench's data") from error
    for path, px in given.items():
        if px is None and not path.stem.startswith("fisheye_"):
            raise SystemExit(f"{path.name} is none of PoseBench's sets: give its threshold in pixels, --threshold PX")
    for path, px in given.items():
        if px is None:
            console.print(f"{path.name}: left out, its cameras are no pinholes", style="dim", highlight=False)
            continue
        try:
            dataset = data.load("h5", root=path, layout="posebench")
        except DataError as error:
            raise SystemExit(str(error)) from error
        every = [dataset[i] for i in range(len(dataset))]
        yield Set(path.stem, [Item(p, functools.partial(_given, p), {"threshold": px}) for p in every], dataset.digest)


def _given(pair: ImagePair) -> Outcome:
    assert pair.matches is not None
    try:
        c, counts = pair.matches()
    except (ValueError, DataError) as error:
        return Outcome(pair, reason=str(error))
    return Outcome(pair, counts, c)


@dataclasses.dataclass(frozen=True)
class Protocol:
    """An estimator by PoseBench's protocol.

    kind: of `KINDS`. preset: of an estimator. changes: options that replace the protocol's. matches: their digest.
    """

    name: str
    kind: str
    preset: str
    changes: dict[str, Any]
    matches: str = ""

    @classmethod
    def of(cls, text: str) -> Protocol:
        """``KIND:PRESET[:KEY=VALUE,...]``. Raises SystemExit for anything else."""
        kind, _, rest = text.partition(":")
        preset, _, settings = rest.partition(":")
        if kind not in KINDS or preset not in presets.available("estimator"):
            raise SystemExit(f"{text}: write KIND:PRESET[:KEY=VALUE,...], KIND being E or F, PRESET one of `fmtorch list`")
        return cls(text, kind, preset, options(settings))

    @functools.cached_property
    def identity(self) -> str:
        """Of its options at 1 px, code, and versions of peers."""
        return identity([("estimator", self.preset, self.options(1.0))], self.name, self.matches)

    def options(self, threshold: float) -> dict[str, Any]:
        """The options of a data set whose threshold is so many pixels.

        At most 1,000 samples, at least 100, confidence 0.9999. A peer gets the threshold. Our presets, whose distances
        are of matches that are exact to about a pixel, get them times the threshold, unless ``scaled=false``.
        """
        changes = dict(self.changes)
        scaled = changes.pop(NOT_SCALED, True)
        preset = presets.load("estimator", self.preset)
        if "hypotheses" in preset:  # one of ours
            own = _distances(preset, threshold) if scaled else {}
            own |= {"hypotheses": MAX_ITERATIONS, "confidence": CONFIDENCE}
            if preset.get("focal"):
                own["focal"] = {**own.get("focal", {}), "rounds": MAX_ITERATIONS // FOCAL_SAMPLES}
        else:
            known = {
                "threshold": threshold, "iterations": MAX_ITERATIONS, "min_iterations": MIN_ITERATIONS,
                "confidence": CONFIDENCE, "two_view": False,
            }  # fmt: skip
            own = {name: value for name, value in known.items() if name in preset}
        return merged(own, changes)

    def applies(self, item: Item) -> bool:
        return True

    def figures(self, item: Item, seed: int) -> Row:
        """What it makes of a pair: signed angles in degrees, 180 where it has no pose, and milliseconds."""
        matched, pair = item.outcome, item.pair
        assert matched is not None
        c = matched.correspondences
        if c is None:
            return {**judged(matched, seed, signed=True), "ms": 0.0}
        given: dict[str, Any] = {
            "mask": c.mask, "quality": c.quality, "size0": c.size0, "size1": c.size1, "key": pair.key, "seed": seed,
            "estimator": self.preset, **self.options(item.facts["threshold"]),
        }  # fmt: skip
        start = time.process_time()
        try:
            if self.kind == "E":
                estimate = fmtorch.find_essential(c.x0, c.x1, pair.K0, pair.K1, **given)  # type: ignore[arg-type]
            else:
                estimate = fmtorch.find_fundamental(c.x0, c.x1, **given)
            outcome = dataclasses.replace(matched, estimate=estimate, reason=estimate.reason[0])
        except ValueError as error:
            outcome = Outcome(pair, reason=str(error))
        ms = 1e3 * (time.process_time() - start)
        return {**judged(outcome, seed, signed=True), "ms": ms}


def _distances(preset: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """The distances within a preset, at any depth, times `scale`."""
    levels = {key: _distances(value, scale) for key, value in preset.items() if isinstance(value, Mapping)}
    own = {key: value * scale for key, value in preset.items() if key in IN_PIXELS and value is not None}
    return {**{key: inside for key, inside in levels.items() if inside}, **own}


def installed(words: Sequence[str]) -> list[Protocol]:
    """The methods whose packages are there; of those that are named, all must be. Raises SystemExit for another."""
    available = []
    for text in words:
        method = Protocol.of(text)
        try:
            presets.build("estimator", method.preset)
            available.append(method)
        except ImportError as error:
            if words is not METHODS:
                raise SystemExit(f"{text}: {error}") from error
            console.print(f"{text} is left out: {error}", style="dim", highlight=False, markup=False)
    return available


def _say_what_is_missing(name: str, items: Sequence[Item], rows: Sequence[Row]) -> None:
    """Pairs that are left out, with the commonest reason, and those that a method has no pose for."""
    reasons = Counter(item.pair.problem for item in items if item.pair.problem is not None)
    if reasons:
        left, (reason, _) = sum(reasons.values()), reasons.most_common(1)[0]
        console.print(f"{name}: {left} of {len(items)} pairs left out: {reason}", style="dim", highlight=False)
    for method, count in Counter(row["method"] for row in rows if row["reason"]).items():
        reason = next(row["reason"] for row in rows if row["method"] == method and row["reason"])
        console.print(f"{name}, {method}: {count} misses, such as: {reason}", style="dim", highlight=False)


def read_published() -> tuple[dict[str, float], Figures]:
    """The threshold of each of PoseBench's sets in pixels, and its published figures."""
    thresholds: dict[str, float] = {}
    figures: Figures = {}
    with PUBLISHED.open(encoding="utf-8") as file:
        for line in csv.DictReader(file):
            thresholds[line["dataset"]] = float(line["threshold"])
            values = tuple(float(line[f"auc{t}"]) for t in POSE_THRESHOLDS)
            figures.setdefault(line["method"], {})[line["dataset"]] = values
    return thresholds, figures


def sheet(rows: dict[str, list[Row]], methods: Sequence[str], published: tuple[dict[str, float], Figures]) -> Sheet:
    """Means over the sets, then each set, with published figures, also of methods that were not run."""
    thresholds, theirs = published
    own = {m: {name: [row for row in of if row["method"] == m] for name, of in rows.items()} for m in methods}
    known = [name for name in rows if name in thresholds]
    others = [method for method in theirs if method not in methods and known]
    records: list[Record] = []
    for method in (*methods, *others):
        of_sets, said = own.get(method, {}), theirs.get(method, {})
        line: Record = {"set": "mean of the sets", "method": method, "px": "", "pairs": sum(map(len, of_sets.values())) or ""}
        line |= _areas("AUC", mean([areas(of) for of in of_sets.values()]))
        line["first of its kind minus this, @5"] = lead(own, method)
        line["ms"] = f"{np.median([row['ms'] for of in of_sets.values() for row in of]):.1f}" if of_sets else ""
        records.append(line | _areas("published", mean([said[name] for name in rows]) if said and len(known) == len(rows) else ()))
    for name in rows:
        for method in (*methods, *(others if name in known else ())):
            of = own.get(method, {}).get(name, [])
            line = {"set": name, "method": method, "px": f"{rows[name][0]['threshold']:g}", "pairs": len(of) or ""}
            records.append(line | _areas("AUC", areas(of)) | _areas("published", theirs.get(method, {}).get(name, ())))
    part = f", {len(known)} of PoseBench's {len(thresholds)}" if known else ""
    count = sum(len(of) for of in own[methods[0]].values())
    return Sheet("poses", f"PoseBench's protocol: {len(rows)} sets{part}; {count:,} pairs; AUC of signed angles, %", records)


def _areas(name: str, values: Sequence[float]) -> Record:
    return {f"{name}@{t}": f"{value:.1f}" for t, value in zip(POSE_THRESHOLDS, values, strict=False)}


def lead(own: dict[str, dict[str, list[Row]]], method: str) -> Span | str:
    """AUC@5 of the first method of a kind minus that of another, every set counting alike, with its 95 % interval."""
    first = next((name for name in own if name[0] == method[0]), method)
    if method == first or method not in own:
        return ""
    scenes = [row["scene"] for of in own[method].values() for row in of]
    if len(set(scenes)) < MIN_UNITS:
        scenes = [str(i) for i in range(len(scenes))]
    share = np.concatenate([np.full(len(of), len(scenes) / len(own[method]) / len(of)) for of in own[method].values()])
    a, b = (share * np.array([_below(row) for of in own[name].values() for row in of]) for name in (first, method))
    return span(difference(a, b, scenes, PERCENT), "+.1f")


def _below(row: Row) -> float:
    """The share of thresholds up to 5 degrees above the error."""
    return max(0.0, 1 - _worst(row) / POSE_THRESHOLDS[0])


def _worst(row: Row) -> float:
    return float(max(row["rotation_error"], row["translation_error"]))


def areas(rows: Sequence[Row]) -> tuple[float, ...]:
    """AUC in per cent at each of the thresholds; none of no rows."""
    worst = torch.tensor([_worst(row) for row in rows], dtype=torch.float64)
    return tuple((100 * metrics.pose_auc(worst, POSE_THRESHOLDS)).tolist()) if rows else ()


def mean(figures: Sequence[tuple[float, ...]]) -> tuple[float, ...]:
    """Of several sets."""
    return tuple(np.mean(figures, 0).tolist()) if figures else ()
