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
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch import presets
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import ImagePair
from fmtorch.estimators import PairwiseEstimator
from fmtorch.two_view.known_cameras import KnownCameras
from scripts.benchmark import pairs
from scripts.benchmark.methods import build, options, read_specs
from scripts.benchmark.runner import Item, Kept, Measured, Row, add_command, identity, judged, measure
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
    """Whether the cameras of a pair are known."""
    return all(value is not None for value in (pair.K0, pair.K1, pair.R, pair.t))


class Knowledge(NamedTuple):
    """What a method is given of two cameras.

    K: (3, 3) of each image, None where unknown. deviation: relative standard deviation of their focal lengths, 0 where
    exact. one_camera: whether both images are of one camera. sizes: (2, 2) as (h, w).
    """

    K: tuple[Array | None, Array | None]
    deviation: float
    one_camera: bool
    sizes: Array

    def calibrations(self, focals: Array) -> tuple[Array, Array]:
        """Those that are given, and of square pixels with these focal lengths (2,) in pixels in place of others.

        Principal points are those that are given or the centres of the images.
        """
        centres = [(size[::-1] - 1) / 2 for size in self.sizes]
        K0, K1 = (
            np.array([[f, 0, x], [0, f, y], [0, 0, 1]]) if K is None else K
            for K, f, (x, y) in zip(self.K, focals, centres, strict=True)
        )
        return K0, K1


def focals_of(K0: Array | None, K1: Array | None) -> Array:
    """The focal lengths (2,) in pixels, geometric means of those along x and y; NaN where unknown."""
    return np.array([np.nan if K is None else np.sqrt(K[0, 0] * K[1, 1]) for K in (K0, K1)])


def applies(level: str, pair: ImagePair) -> bool:
    """Whether what a level takes for true holds: `shared` is of pairs of one camera."""
    f0, f1 = focals_of(pair.K0, pair.K1)
    return level != "shared" or bool(abs(np.log(f0 / f1)) < ONE_CAMERA)


def knowledge(level: str, pair: ImagePair, sizes: Array, seed: int) -> Knowledge:
    """What a level tells of a pair's cameras. sizes: (2, 2) as (h, w). seed: of roughly known focal lengths."""
    factors, deviation = np.ones(2), 0.0
    if level == "rough":
        rng = np.random.default_rng([pair.key % 2**64, seed])
        factors, deviation = np.exp(rng.uniform(-np.log(ROUGH), np.log(ROUGH), 2)), DEVIATION
    elif level == "wrong":
        factors, deviation = np.full(2, WRONG), DEVIATION
    told = {"one_sided": 1, "shared": 0, "unknown": 0}.get(level, 2)
    K = [k @ np.diag([f, f, 1.0]) for k, f in zip((pair.K0, pair.K1), factors, strict=True) if k is not None]
    given = (K[0] if told > 0 else None, K[1] if told > 1 else None)
    return Knowledge(given, deviation, level == "shared", sizes)


Solve = Callable[[Correspondences, Knowledge, int], Estimate]


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
        c, pair = item.matches, item.pair
        assert c.size0 is not None
        assert c.size1 is not None
        given = knowledge(self.level, pair, np.stack([c.size0[0].numpy(), c.size1[0].numpy()]), seed)
        start = time.process_time()
        estimate = self.solve(c, given, seed)
        ms = 1e3 * (time.process_time() - start)
        assert item.outcome is not None
        inliers = estimate.inliers if estimate.inliers.shape == c.mask.shape else c.mask
        estimate = estimate.replace(inliers=inliers)
        outcome = dataclasses.replace(item.outcome, estimate=estimate, reason=estimate.reason[0])
        row = {**judged(outcome, seed), "ms": ms}
        if estimate.t is not None and pair.t is not None and bool(estimate.ok[0]) and bool(estimate.t.isfinite().all()):
            row["flipped"] = bool(estimate.t[0].double().numpy() @ pair.t < 0)
        asked = [K is None or given.deviation > 0 for K in given.K]
        if any(asked):
            found = focals_of(*given.K)
            if bool(estimate.ok[0]) and estimate.focals is not None:
                found = np.where(estimate.focals[0].isfinite(), estimate.focals[0].double().numpy(), np.inf)
            errors = np.abs(found / focals_of(pair.K0, pair.K1) - 1)[asked]
            row |= {f"focal_{round(100 * bound)}": float((errors <= bound).mean()) for bound in FOCAL_ERRORS}
        return row


def _solver(name: str, level: str, changed: dict[str, Any]) -> tuple[Solve, list[tuple[str, str, dict[str, Any]]]]:
    """What a method computes, and the presets that it is made of."""
    kind, _, alone = name.partition("_")
    if kind == "fmtorch":
        prior = [build("pruner", word) for word in PRIOR]
        own = _with_cameras if not alone else _decomposed
        solve = functools.partial(own, presets.build("estimator", kind, **changed), exact=False)
        stages = [("estimator", kind, changed), *(("pruner", word, {}) for word in PRIOR)]
        return lambda c, given, seed: solve(functools.reduce(lambda x, stage: stage(x), prior, c), given, seed), stages
    if kind in ESSENTIAL:
        solve = functools.partial(_with_cameras, _by_essential(kind, changed), exact=True)
        return functools.partial(_best_first, solve), []
    usual: dict[str, Any] = {"iterations": 5000, "prosac": True} if kind == "poselib" else {"two_view": not alone}
    shared = {"shared_focal": True} if (name, level) == ("poselib", "shared") else {}
    changed = {**usual, **shared, **changed}
    try:
        estimator = presets.build("estimator", kind, **changed)
    except ImportError as error:
        raise SystemExit(f"{name}: {error}") from error
    call = functools.partial(_decomposed if alone or shared else _with_cameras, estimator, exact=True)
    return functools.partial(_best_first, call), [("estimator", kind, changed)]


def _with_cameras(estimator: Any, c: Correspondences, given: Knowledge, seed: int, exact: bool) -> Estimate:
    """By an estimator that takes cameras. exact: it is another library's, which takes what is given for exact."""
    K0, K1 = (None if K is None else torch.from_numpy(np.asarray(K))[None] for K in given.K)
    deviations = [np.inf if K is None else 0.0 if exact else given.deviation for K in given.K]
    focal = torch.tensor([[[1.0, deviation] for deviation in deviations]], dtype=torch.float64)
    fields = {"K0": K0, "K1": K1, "focal": focal, "shared_focal": torch.tensor([given.one_camera])}
    estimate: Estimate = KnownCameras(estimator)(c.replace(**fields), seed).detach()
    lacks_pose = estimate.t is None or not bool(estimate.t.isfinite().all())
    return _posed(estimate, c, given) if exact and lacks_pose else estimate


def _best_first(solve: Solve, c: Correspondences, given: Knowledge, seed: int) -> Estimate:
    """By another library, which gets the matches in ascending order of their ratios."""
    assert c.ratio is not None
    order = c.ratio[0].argsort(stable=True)
    slots = {name: getattr(c, name)[:, order] for name in c.per_slot if getattr(c, name) is not None}
    estimate = solve(c.replace(**slots), given, seed)
    return estimate.replace(inliers=estimate.inliers[:, order.argsort()])


def _decomposed(estimator: Any, c: Correspondences, given: Knowledge, seed: int, exact: bool) -> Estimate:
    """F by an estimator that is told nothing of the cameras, and its pose."""
    return _posed(estimator(c.replace(K0=None, K1=None), seed).detach(), c, given)


def _posed(estimate: Estimate, c: Correspondences, given: Knowledge) -> Estimate:
    """The estimate with the pose of F, by the given calibrations or else focal lengths by `bougnoux`."""
    inliers = estimate.inliers[0].numpy()
    if not bool(estimate.ok[0]) or not inliers.any():
        return estimate
    F = estimate.F[0].double().numpy()
    K0, K1 = given.calibrations(bougnoux(F, given))
    normalised = [rays(x[0].double().numpy()[inliers], K) for x, K in ((c.x0, K0), (c.x1, K1))]
    far = 1e9  # baselines: OpenCV's own bound of 50 rejects short ones
    _, R, t, _, _ = cv2.recoverPose(K1.T @ F @ K0, normalised[0], normalised[1], np.eye(3), distanceThresh=far)
    pose = {"R": np.asarray(R), "t": np.asarray(t).ravel(), "focals": focals_of(K0, K1)}
    return estimate.replace(**{name: torch.from_numpy(np.asarray(v, np.float64))[None] for name, v in pose.items()})


def rays(x: Array, K: Array) -> Array:
    """Pixels (n, 2) in units of the focal length, from the principal point."""
    return np.ascontiguousarray((np.c_[x, np.ones(len(x))] @ np.linalg.inv(K).T)[:, :2])


def bougnoux(F: Array, given: Knowledge) -> Array:
    """Focal lengths (2,) in pixels by Bougnoux's formula (ICCV 1998); usual ones for both where one is not real."""
    centre0, centre1 = Knowledge((None, None), 0.0, False, given.sizes).calibrations(np.ones(2))
    for centre, K in ((centre0, given.K[0]), (centre1, given.K[1])):
        centre[:2, 2] = centre[:2, 2] if K is None else K[:2, 2]
    G = centre1.T @ F @ centre0
    squares = np.array([_squared_focal(G), _squared_focal(G.T)])
    usual = USUAL * given.sizes.max(1)
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
    """Each level's methods on each set, and what our own method of the level, or else the first of it, has more."""
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
