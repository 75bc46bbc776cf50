"""Pose, focal lengths and F by what is known of the cameras, beside PoseLib, COLMAP, OpenCV and kornia.

A method is named as NAME:LEVEL[:KEY=VALUE,...]. Levels: known; rough (each focal length times a log-uniform factor of
its own, 1/1.1 to 1.1, given with a deviation of 6 %); wrong (1.5 times too long, given as rough); one_sided (K0 alone);
shared (one unknown focal length; of pairs of one camera alone); unknown. Peers take a calibration for exact. All
methods get the same SIFT matches; P(inlier) and noise from the keypoints' frames are part of ours, and of its time.

python -m scripts.benchmark cameras --root DATA/Strecha --root DATA/KITTI --specs scripts/benchmark/cameras.txt \\
    --seeds 3 --rows rows.jsonl --table docs/tables/cameras.csv
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import ImagePair
from fmtorch.estimators import PairwiseEstimator
from fmtorch.evaluation.rows import focal_errors
from fmtorch.pipeline.pipeline import Outcome
from fmtorch.presets import build
from fmtorch.scenes.raycast import calibration
from fmtorch.two_view.known_cameras import KnownCameras
from scripts.benchmark import pairs
from scripts.benchmark.changes import sizes_of, taken
from scripts.benchmark.methods import options, read_specs
from scripts.benchmark.runner import Item, Kept, Measured, Row, Stages, add_command, identity, judged, measure
from scripts.benchmark.tables import Record, Results, Sheet, show

Array = NDArray[Any]
LEVELS = ("known", "rough", "wrong", "one_sided", "shared", "unknown")
ROUGH = 1.1  # largest factor of a roughly known focal length; log-uniform, of each camera its own
DEVIATION = 0.06  # relative, of such a factor: log(1.1) / sqrt(3), rounded up
WRONG = 1.5  # factor of a wrong focal length
USUAL = 1.2  # focal length in units of the longer side where F has no real one: COLMAP's default
ONE_CAMERA = 1e-3  # relative difference up to which two focal lengths are one
FOCAL_ERRORS = (0.05, 0.1)  # relative
PRIOR = ("frame_consistency", "match_noise")  # P(inlier) and noise of each match, before our own estimator
EXACT = ("known", "rough", "wrong")
TAKES = {
    "fmtorch": LEVELS, "fmtorch_f": LEVELS, "poselib": (*EXACT, "shared"),
    "poselib_f": (*EXACT, "one_sided", "shared", "unknown"), "colmap": (*EXACT, "one_sided", "shared", "unknown"),
    "colmap_f": EXACT, "opencv": EXACT, "kornia": EXACT,
}  # fmt: skip
"""The levels that each method takes; ``_f``: a fundamental matrix without cameras, of which the pose is taken."""


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "cameras", run, __doc__, seeds=1)
    pairs.add_match_options(parser)
    parser.add_argument("--methods", nargs="+", default=[], help="NAME:LEVEL[:KEY=VALUE,...]")
    parser.add_argument("--specs", type=Path, help="a file with one method a line; # starts a comment")


def run(arguments: argparse.Namespace) -> None:
    def measured_rows(kept: Kept) -> list[Row]:
        words = [*arguments.methods, *(read_specs(arguments.specs) if arguments.specs else [])]
        if not words:
            raise SystemExit("name at least one method: --methods or --specs")
        matches = pairs.matches_identity(arguments)
        items = [item for item in pairs.matched(arguments) if has_cameras(item.pair)]
        if not items:
            raise SystemExit("no pair has cameras; a --root must hold Camera.txt files")
        return measure([CameraMethod.of(word, matches) for word in words], items, arguments.seeds, kept)

    show([sheet(pairs.rows_of(arguments, measured_rows))], arguments.table)


def has_cameras(pair: ImagePair) -> bool:
    return all(value is not None for value in (pair.K0, pair.K1, pair.R, pair.t))


def focals_of(*calibrations: Array | None) -> Array:
    """The focal lengths in pixels, geometric means of those along x and y; NaN where unknown."""
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


Solve = Callable[[Correspondences, int], Estimate]


@dataclasses.dataclass(frozen=True)
class CameraMethod(Measured):
    """An estimator that is given what a level tells of the cameras."""

    name: str
    level: str
    solve: Solve
    identity: str

    @classmethod
    def of(cls, text: str, matches: str = "") -> CameraMethod:
        """The method of ``NAME:LEVEL[:KEY=VALUE,...]``. Raises SystemExit for anything else."""
        name, _, rest = text.partition(":")
        level, _, settings = rest.partition(":")
        if level not in LEVELS:
            raise SystemExit(f"{text}: write NAME:LEVEL[:KEY=VALUE,...] with a level of {', '.join(LEVELS)}")
        if name not in TAKES:
            raise SystemExit(f"{text}: no method {name!r}; there are {', '.join(TAKES)}")
        if level not in TAKES[name]:
            raise SystemExit(f"{text}: {name} has no estimator for {level!r}; it has: {', '.join(TAKES[name])}")
        solve, made_with = _solver(name, level, options(settings))
        return cls(text, level, solve, identity(made_with, text, matches, Path(__file__).read_text()))

    def applies(self, item: Item) -> bool:
        return applies(self.level, item.pair)

    def figures(self, item: Item, seed: int) -> Row:
        """The figures of F and pose, whether t points backwards, and the errors of focal lengths not given exactly."""
        pair, c = item.pair, described(self.level, item.pair, item.matches, seed)
        start = time.process_time()
        estimate = self.solve(c, seed)
        ms = 1e3 * (time.process_time() - start)
        inliers = estimate.inliers if estimate.inliers.shape == c.mask.shape else c.mask
        estimate = estimate.replace(inliers=inliers)
        assert item.outcome is not None
        outcome = Outcome(pair, item.outcome.features, c, estimate, reason=estimate.reason[0])
        row = {**judged(outcome, seed), "ms": ms}
        if estimate.t is not None and pair.t is not None and bool(estimate.ok[0]) and bool(estimate.t.isfinite().all()):
            row["flipped"] = bool(estimate.t[0].double().numpy() @ pair.t < 0)
        if errors := [error for error in focal_errors(outcome).error if error is not None]:
            row |= {f"focal_{round(100 * bound)}": float(np.mean(np.array(errors) <= bound)) for bound in FOCAL_ERRORS}
        return row


def _solver(name: str, level: str, changed: dict[str, Any]) -> tuple[Solve, Stages]:
    """What a method computes, and the presets that it is made of."""
    kind, _, alone = name.partition("_")
    if kind == "fmtorch":
        prior = [build("pruner", word) for word in PRIOR]
        own = functools.partial(_decomposed if alone else _with_cameras, build("estimator", kind, **changed))
        stages: Stages = [("estimator", kind, changed), *(("pruner", word, {}) for word in PRIOR)]
        return lambda c, seed: own(functools.reduce(lambda given, stage: stage(given), prior, c), seed), stages
    if kind in ESSENTIAL:
        return functools.partial(_peer, _with_cameras, _by_essential(kind, changed)), []
    usual: dict[str, Any] = {"iterations": 5000, "prosac": True} if kind == "poselib" else {"two_view": not alone}
    shared = {"shared_focal": True} if (name, level) == ("poselib", "shared") else {}
    changed = {**usual, **shared, **changed}
    try:
        estimator = build("estimator", kind, **changed)
    except ImportError as error:
        raise SystemExit(f"{name}: {error}") from error
    call = _decomposed if alone or shared else _with_cameras
    return functools.partial(_peer, call, estimator), [("estimator", kind, changed)]


def _with_cameras(estimator: Any, c: Correspondences, seed: int) -> Estimate:
    return KnownCameras(estimator)(c, seed).detach()


def _peer(call: Callable[..., Estimate], estimator: Any, c: Correspondences, seed: int) -> Estimate:
    """By another library, which takes what is given for exact, and gets the matches in ascending order of ratios."""
    assert c.ratio is not None
    assert c.focal is not None
    order = c.ratio[0].argsort(stable=True)
    exact = torch.where(c.focal.isinf(), torch.inf, torch.tensor([1.0, 0.0], dtype=torch.float64))
    best_first = taken(c.replace(focal=exact), order)
    estimate = call(estimator, best_first, seed)
    if estimate.t is None or not bool(estimate.t.isfinite().all()):
        estimate = _posed(estimate, best_first)
    return estimate.replace(inliers=estimate.inliers[:, order.argsort()])


def _decomposed(estimator: Any, c: Correspondences, seed: int) -> Estimate:
    """F by an estimator that is told nothing of the cameras, and its pose."""
    return _posed(estimator(c.replace(K0=None, K1=None, focal=None, shared_focal=None), seed).detach(), c)


def _posed(estimate: Estimate, c: Correspondences) -> Estimate:
    """The estimate with the pose of F, by the given calibrations or else focal lengths by `bougnoux`."""
    inliers = estimate.inliers[0].numpy()
    if not bool(estimate.ok[0]) or not inliers.any():
        return estimate
    F = estimate.F[0].double().numpy()
    K0, K1 = calibrations(c, bougnoux(F, c))
    normalised = [rays(x[0].double().numpy()[inliers], K) for x, K in ((c.x0, K0), (c.x1, K1))]
    far = 1e9  # baselines: OpenCV's own bound of 50 rejects short ones
    _, R, t, _, _ = cv2.recoverPose(K1.T @ F @ K0, normalised[0], normalised[1], np.eye(3), distanceThresh=far)
    pose = {"R": np.asarray(R), "t": np.asarray(t).ravel(), "focals": focals_of(K0, K1)}
    return estimate.replace(**{name: torch.from_numpy(np.asarray(v, np.float64))[None] for name, v in pose.items()})


def rays(x: Array, K: Array) -> Array:
    """Pixels (n, 2) in units of the focal length, from the principal point."""
    return np.ascontiguousarray((np.c_[x, np.ones(len(x))] @ np.linalg.inv(K).T)[:, :2])


def bougnoux(F: Array, c: Correspondences) -> Array:
    """Focal lengths (2,) in pixels by Bougnoux's formula (ICCV 1998); usual ones for both where one is not real."""
    centres = calibrations(c.replace(K0=None, K1=None), np.ones(2))
    for centre, K in zip(centres, calibrations(c, np.ones(2)), strict=True):
        centre[:2, 2] = K[:2, 2]
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
    E, mask = ransac(*(torch.from_numpy(rays(x, K)) for x, K in ((pair.x0, K0), (pair.x1, K1))))
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


def sheet(rows: Sequence[Row]) -> Sheet:
    records: list[Record] = []
    columns = [*(f"pose@{t}" for t in (5, 10, 20)), "R.01", "AUC@0.05", "flipped, %"]
    columns += [*(f"focal within {p} %, %" for p in (5, 10)), "ms", "time ratio"]
    for level in LEVELS:
        own = [row for row in rows if row["method"].split(":")[1] == level]
        results = Results(sorted(own, key=lambda row: row["method"].split(":")[0] != "fmtorch"))
        lines = results.records(results.groups(results.all_pairs), columns, "method", ["pose@5"])
        records += [{"known": level, "method": line.pop("method"), **line} for line in lines]
    title = "AUC of the larger pose error at 5, 10 and 20 degrees, recall and AUC@0.05 of F, in %"
    return Sheet("poses", title, records)
