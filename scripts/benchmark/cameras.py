"""Pose, focal lengths and F by what is known of the cameras, beside PoseLib, fastpose, COLMAP, OpenCV and kornia.

A method is named as NAME:LEVEL[:KEY=VALUE,...]. Levels: known; rough (each focal length times a log-uniform factor of
its own, 1/1.1 to 1.1, given with a deviation of 6 %); wrong (1.5 times too long, given as rough); one_sided (K0 alone);
shared (one unknown focal length; of pairs of one camera alone); unknown. Peers take a calibration for exact. P(inlier)
and noise from the keypoints' frames are part of ours, and of its time.
"""

import argparse
import csv
import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch import data, metrics, presets
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import DataError, ImagePair
from fmtorch.estimators import PairwiseEstimator
from fmtorch.evaluation.statistics import MIN_UNITS, PERCENT, POSE_THRESHOLDS, difference
from fmtorch.geometry import pose_from_fundamental
from fmtorch.geometry.pose import calibrated
from fmtorch.io import h5
from fmtorch.pipeline.pipeline import Outcome
from fmtorch.scenes.raycast import calibration
from fmtorch.two_view.known_cameras import KnownCameras
from scripts.benchmark import pairs
from scripts.benchmark.changes import sizes_of, taken
from scripts.benchmark.methods import estimate_by_call, options, specs_of, split
from scripts.benchmark.runner import Item, Kept, Method, Row, Stages, add_command, console, identity, measure
from scripts.benchmark.tables import FIGURES, Record, Results, Sheet, Span, show, span

Array = NDArray[Any]
LEVELS = ("known", "rough", "wrong", "one_sided", "shared", "unknown")
ROUGH = 1.1  # largest factor of a roughly known focal length; log-uniform, of each camera its own
DEVIATION = 0.06  # relative, of such a factor: log(1.1) / sqrt(3), rounded up
WRONG = 1.5  # factor of a wrong focal length
USUAL = 1.2  # focal length in units of the longer side where F has no real one: COLMAP's default
ONE_CAMERA = 1e-3  # relative difference up to which two focal lengths are one
PRIOR = ("frame_consistency", "match_noise")  # P(inlier) and noise of each match, before our own estimator
EXACT = ("known", "rough", "wrong")
TAKES = {
    "fmtorch": LEVELS, "fmtorch_f": LEVELS, "poselib": (*EXACT, "shared"),
    "poselib_f": (*EXACT, "one_sided", "shared", "unknown"), "colmap": (*EXACT, "one_sided", "shared", "unknown"),
    "opencv": EXACT, "kornia": EXACT, "fastpose": (*EXACT, "shared", "unknown"),
}  # fmt: skip
"""The levels that each method takes; ``_f``: a fundamental matrix without cameras, of which the pose is taken."""
PEERS: dict[str, dict[str, Any]] = {"poselib": {"iterations": 5000, "prosac": True}, "colmap": {"two_view": True}}
POSEBENCH = """PoseBench's relative poses (github.com/PoseLib/posebench) by its protocol, beside its published figures.

FILES is the folder `relative` of its data, or one file of it; --root judges pairs in FM-Bench's layout in the same way,
by SIFT matches and --threshold. Of each pair the error is the larger of the angles of rotation and of translation,
whose sign counts; of a fundamental matrix the best of its four poses is taken. Sets of other names need --threshold;
pairs whose cameras have distortion are left out.
"""
METHODS = ("E:fmtorch", "E:poselib", "E:colmap", "F:fmtorch", "F:poselib", "F:colmap")
KINDS = ("E", "F")  # a relative pose of known cameras; a fundamental matrix, of whose four poses the best one counts
MAX_ITERATIONS, MIN_ITERATIONS, CONFIDENCE = 1000, 100, 0.9999
FOCAL_SAMPLES = 250  # of a round of our search with focal lengths
IN_PIXELS = ("threshold", "inlier_threshold", "scale")  # options of our presets that are distances
PUBLISHED = Path(__file__).with_name("posebench.csv")  # PoseLib 2.0.5; results/baseline.2_0_5.json there
Published = dict[str, dict[str, dict[str, float]]]  # method -> data set -> column -> per cent


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "cameras", run, __doc__, pairs.add_method_options, seeds=1)
    parser.add_argument("--methods", nargs="+", default=[], help="NAME:LEVEL[:KEY=VALUE,...]")
    parser = add_command(commands, "posebench", run_posebench, POSEBENCH, pairs.add_match_options, seeds=1)
    parser.add_argument("files", nargs="?", type=Path, help="the folder `relative` of PoseBench's data, or one file")
    parser.add_argument("--methods", nargs="+", default=METHODS, help="KIND:PRESET[:KEY=VALUE,...], KIND being E or F")
    parser.add_argument("--threshold", type=float, help="px, of sets that are not PoseBench's")
    parser.add_argument("--every", type=int, default=1, help="every so many-th pair of each set; the protocol has all")


def run(arguments: argparse.Namespace) -> None:
    def measured_rows(kept: Kept) -> list[Row]:
        words, matches = specs_of(arguments.methods, arguments.specs), pairs.matches_identity(arguments)
        items = [item for item in pairs.matched(arguments) if has_cameras(item.pair)]
        if not items:
            raise SystemExit("no pair has cameras; a --root must hold Camera.txt files")
        return measure([method_of(word, matches) for word in words], items, arguments.seeds, kept)

    show([sheet(pairs.rows_of(arguments, measured_rows), arguments.shares)], arguments.table)


def has_cameras(pair: ImagePair) -> bool:
    return all(value is not None for value in (pair.K0, pair.K1, pair.R, pair.t))


def focals_of(*calibrations: Array | None) -> Array:
    return np.array([np.nan if K is None else np.sqrt(K[0, 0] * K[1, 1]) for K in calibrations])


def applies(level: str, pair: ImagePair) -> bool:
    """Whether what a level takes for true holds: `shared` is of pairs of one camera."""
    f0, f1 = focals_of(pair.K0, pair.K1)
    return level != "shared" or bool(abs(np.log(f0 / f1)) < ONE_CAMERA)


def described(level: str, pair: ImagePair, c: Correspondences, seed: int) -> Correspondences:
    """The matches with what a level tells of their cameras. seed: of roughly known focal lengths."""
    factors, deviation = np.ones(2), 0.0
    if level == "rough":
        rng = np.random.default_rng([pair.key % 2**64, seed])
        factors, deviation = np.exp(rng.uniform(-np.log(ROUGH), np.log(ROUGH), 2)), DEVIATION
    elif level == "wrong":
        factors, deviation = np.full(2, WRONG), DEVIATION
    known = np.arange(2) < {"one_sided": 1, "shared": 0, "unknown": 0}.get(level, 2)
    K = [torch.from_numpy(np.asarray(own) @ np.diag([f, f, 1.0]))[None] if given else None
         for own, f, given in zip((pair.K0, pair.K1), factors, known, strict=True)]  # fmt: skip
    focal = torch.tensor([[[1.0, deviation if given else np.inf] for given in known]], dtype=torch.float64)
    return c.replace(K0=K[0], K1=K[1], focal=focal, shared_focal=torch.tensor([level == "shared"]))


def calibrations(c: Correspondences, focals: Array) -> list[Array]:
    """Those that are given; for others square pixels, these focal lengths (2,) in pixels and the centres of images."""
    unknown = [calibration(f, (h, w)) for f, (h, w) in zip(focals, sizes_of(c), strict=True)]
    return [own if K is None else K[0].numpy() for own, K in zip(unknown, (c.K0, c.K1), strict=True)]


def viewed(level: str, outcome: Outcome, seed: int) -> Outcome:
    assert outcome.correspondences is not None
    return dataclasses.replace(outcome, correspondences=described(level, outcome.pair, outcome.correspondences, seed))


def method_of(text: str, matches: str = "") -> Method:
    """The method of ``NAME:LEVEL[:KEY=VALUE,...]``. Raises SystemExit for anything else."""
    name, _, rest = text.partition(":")
    level, _, settings = rest.partition(":")
    if level not in LEVELS:
        raise SystemExit(f"{text}: write NAME:LEVEL[:KEY=VALUE,...] with a level of {', '.join(LEVELS)}")
    if name not in TAKES:
        raise SystemExit(f"{text}: no method {name!r}; there are {', '.join(TAKES)}")
    if level not in TAKES[name]:
        raise SystemExit(f"{text}: {name} has no estimator for {level!r}; it has: {', '.join(TAKES[name])}")
    kind, changed = name.partition("_")[0], options(settings)
    prior = {word: presets.build("pruner", word) for word in PRIOR} if kind == "fmtorch" else {}
    solve, made_with = _solver(name, level, changed)
    made_with = [*made_with, *(("pruner", word, {}) for word in prior)]
    return Method(
        text, identity(made_with, text, matches, Path(__file__).read_text()), lambda family: prior,
        lambda pair, c, seed: solve(c, seed), takes=lambda item: applies(level, item.pair),
        view=functools.partial(viewed, level),
    )  # fmt: skip


def _solver(name: str, level: str, changed: dict[str, Any]) -> tuple[Callable[..., Estimate], Stages]:
    """What a method computes, and the preset that it is made of."""
    kind, _, alone = name.partition("_")
    if kind in ESSENTIAL:
        return functools.partial(_peer, functools.partial(_with_cameras, _by_essential(kind, changed))), []
    shared = {"shared_focal": True} if (name, level) == ("poselib", "shared") else {}
    changed = {**PEERS.get(kind, {}), **shared, **changed}
    try:
        estimator = presets.build("estimator", kind, **changed)
    except ImportError as error:
        raise SystemExit(f"{name}: {error}") from error
    call = functools.partial(_decomposed if alone or shared else _with_cameras, estimator)
    return call if kind == "fmtorch" else functools.partial(_peer, call), [("estimator", kind, changed)]


def _with_cameras(estimator: Any, c: Correspondences, seed: int) -> Estimate:
    return KnownCameras(estimator)(c, seed).detach()


def _peer(call: Callable[..., Estimate], c: Correspondences, seed: int) -> Estimate:
    """By another library, which takes what is given for exact, and gets the matches in ascending order of ambiguity."""
    assert c.ambiguity is not None
    assert c.focal is not None
    order = c.ambiguity[0].argsort(stable=True)
    exact = torch.where(c.focal.isinf(), torch.inf, torch.tensor([1.0, 0.0], dtype=torch.float64))
    best_first = taken(c.replace(focal=exact), order)
    estimate = call(best_first, seed)
    if estimate.t is None or not bool(estimate.t.isfinite().all()):
        estimate = _posed(estimate, best_first)
    return estimate.replace(inliers=estimate.inliers[:, order.argsort()])


def _decomposed(estimator: Any, c: Correspondences, seed: int) -> Estimate:
    """F by an estimator that is told nothing of the cameras, and its pose."""
    return _posed(estimator(c.replace(K0=None, K1=None, focal=None, shared_focal=None), seed).detach(), c)


def _posed(estimate: Estimate, c: Correspondences) -> Estimate:
    """The estimate with the pose of F, by the given calibrations or else focal lengths by `bougnoux`."""
    if not bool(estimate.ok[0]) or not bool(estimate.inliers.any()):
        return estimate
    F, x0, x1 = (value.double() for value in (estimate.F, c.x0, c.x1))
    K0, K1 = (torch.from_numpy(K)[None] for K in calibrations(c, bougnoux(F[0].numpy(), c)))
    pose = pose_from_fundamental(F, K0, K1, x0, x1, estimate.inliers)
    return estimate.replace(R=pose.R, t=pose.t, focals=torch.from_numpy(focals_of(K0[0].numpy(), K1[0].numpy()))[None])


def bougnoux(F: Array, c: Correspondences) -> Array:
    """Focal lengths (2,) in pixels by Bougnoux's formula (ICCV 1998); usual ones for both where one is not real."""
    centres = [np.c_[np.eye(3, 2), K[:, 2]] for K in calibrations(c, np.ones(2))]
    G = centres[1].T @ F @ centres[0]
    squares = np.array([_squared_focal(G), _squared_focal(G.T)])
    usual = USUAL * np.array(sizes_of(c)).max(1)
    return np.asarray(np.sqrt(squares) if np.isfinite(squares).all() and (squares > 0).all() else usual)


def _squared_focal(G: Array) -> float:
    """The squared focal length of the camera whose points G's columns belong to."""
    p, D = np.array([0, 0, 1.0]), np.diag([1.0, 1, 0])
    e = np.linalg.svd(G.T)[2][2]
    row = np.cross(p, e) @ D @ G  # p^T [e]x D G
    with np.errstate(all="ignore"):
        return float(-(row @ p) * (p @ G.T @ p) / (row @ D @ G.T @ p))


def _opencv(
    pair: Any, K0: Array, K1: Array, method: str = "USAC_MAGSAC", threshold: float = 1.0, confidence: float = 0.999
) -> tuple[Any, Any]:
    cv2.setRNGSeed(pair.seed)
    return cv2.findEssentialMat(pair.x0, pair.x1, K0, None, K1, None, getattr(cv2, method), confidence, threshold)


def _kornia(pair: Any, K0: Array, K1: Array, threshold: float = 1.0, rounds: int = 10) -> tuple[Any, Any]:
    from kornia.geometry import RANSAC

    unit = float(np.mean([K0[0, 0], K1[0, 0]]))  # px
    ransac = RANSAC("essential", inl_th=threshold / unit, max_iter=rounds, prosac_sampling=True, seed=pair.seed)
    E, mask = ransac(*(torch.from_numpy(calibrated(x, K)) for x, K in ((pair.x0, K0), (pair.x1, K1))))
    return E.double().numpy(), mask.numpy()


ESSENTIAL: dict[str, Callable[..., tuple[Any, Any]]] = {"opencv": _opencv, "kornia": _kornia}
"""From a pair, K0, K1 and options to E and its inliers."""


def _by_essential(kind: str, changed: dict[str, Any]) -> PairwiseEstimator:
    """An estimator of fundamental matrices by a library's essential matrices, of matches that come best first."""

    def solve(pair: Any) -> tuple[Array | None, Array]:
        K0, K1 = pair.exact
        E, mask = ESSENTIAL[kind](pair, K0, K1, **changed)
        if E is None or mask is None or np.shape(E) != (3, 3):
            return None, np.zeros(len(pair.x0), np.bool_)
        return np.linalg.inv(K1).T @ np.asarray(E, np.float64) @ np.linalg.inv(K0), np.asarray(mask).ravel() > 0

    return PairwiseEstimator(kind, solve, best_first=True)


def sheet(rows: Sequence[Row], shares: Sequence[float]) -> Sheet:
    records: list[Record] = []
    columns = [*(f"pose@{t}" for t in (5, 10, 20)), "R.01", "AUC@0.05", "flipped, %"]
    columns += [*(f"focal within {p} %, %" for p in (5, 10)), "ms", "time ratio"]
    for level in LEVELS:
        own = [row for row in rows if row["method"].split(":")[1] == level]
        results = Results(sorted(own, key=lambda row: row["method"].split(":")[0] != "fmtorch"))
        lines = results.records(results.groups(results.all_pairs, shares), columns, "method", ["pose@5"])
        records += [{"known": level, "method": line.pop("method"), **line} for line in lines]
    return Sheet("poses", "AUC of the larger pose error at 5/10/20 degrees, R.01 and AUC@0.05 of F, in %", records)


# PoseBench


def run_posebench(arguments: argparse.Namespace) -> None:
    thresholds, published = read_published()
    words, kept = list(arguments.methods), Kept(arguments.rows)
    rows: list[Row] = []
    for word in METHODS if words == list(METHODS) else ():
        try:
            presets.build("estimator", word.split(":")[1])
        except ImportError as error:
            words.remove(word)
            console.print(f"{word} is left out: {error}", highlight=False, markup=False)
    for name, threshold, items, digest in sets_of(arguments, thresholds):
        selected = items[:: arguments.every]
        usable = [item for item in selected if item.pair.problem is None]
        for item in usable:
            item.facts["threshold"] = threshold
        methods = [protocol(word, threshold, digest) for word in words]
        own = measure(methods, usable, arguments.seeds, kept)
        say_what_is_missing(name, selected, own)
        rows += [{**row, "family": name} for row in own]
    if not rows:
        raise SystemExit("no pair of pinhole cameras")
    show([posebench_sheet(rows, thresholds, published)], arguments.table)


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
    return presets.merged(own, changes)


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
    lines = list(csv.DictReader(PUBLISHED.read_text(encoding="utf-8").splitlines()))
    for line in lines:
        areas = {f"published: AUC@{t}": float(line[f"auc{t}"]) for t in POSE_THRESHOLDS}
        figures.setdefault(line["method"], {})[line["dataset"]] = areas
    return {line["dataset"]: float(line["threshold"]) for line in lines}, figures


def posebench_sheet(rows: Sequence[Row], thresholds: Mapping[str, float], published: Published) -> Sheet:
    """Means over the sets, then each set, with published figures, also of methods that were not run."""
    results = Results(rows)
    sets = results.by_family(results.all_pairs)
    theirs = {m: {name: of[name] for name in sets if name in of} for m, of in published.items()}
    methods = [*results.methods, *(m for m, of in theirs.items() if of and m not in results.methods)]
    own_pairs = {m: set(results.pairs(m)) if m in results.methods else set() for m in methods}
    means: list[Record] = []
    of_sets: dict[tuple[str, str], Record] = {}
    for m in methods:
        figures = {name: dict(theirs.get(m, {}).get(name, {})) for name in sets}
        for name, own in sets.items() if own_pairs[m] else ():
            figures[name] = areas(results, m, own) | figures[name]
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
    """AUC in per cent at each of the thresholds, by trapezes as PoseBench has it."""
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
