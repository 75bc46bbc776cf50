"""Homographies of photographs as planes: errors and milliseconds beside PoseLib and OpenCV, on the same matches.

Warped: each photograph is seen as a plane, tilted by 20 to 55 degrees over another photograph, with blur and noise.
Hard pairs keep at most 60 of their right matches and 70 % random ones. Views: two pictures of the plane, each rendered
by a camera and under light of its own (`training.planes`). SIFT, ratio 0.8, one match a location, P(inlier) from frame
consistency. Every second photograph is for tuning (--tuning), the others for the claim; --warps pairs are made of each.

The error of a pair is the mean distance of the true and the estimated image of the photograph's corners, or, of views,
of the points of a grid that both see.

python -m scripts.benchmark homography --photographs DATA/photos --seeds 3 --warps 2
python -m scripts.benchmark homography --photographs DATA/photos --tuning --methods ours:select.scale=0.5 poselib:2
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import torch
from rich.progress import track

from fmtorch import find_homography, metrics, presets
from fmtorch.core.types import PAIR_TYPES, Correspondences, Estimate, collate
from fmtorch.estimators.external import colmap
from fmtorch.geometry import poses_from_homography
from fmtorch.two_view.known_cameras import KnownCameras
from fmtorch.two_view.pair_type import classify
from scripts.benchmark import pairs
from scripts.benchmark.methods import options
from scripts.benchmark.photographs import Array, Plane, add_options, kinds, mapped, paths_of, points, views, warped
from scripts.benchmark.runner import Item, Kept, Measured, Row, add_command, console, measure
from scripts.benchmark.tables import Record, Results, Sheet, show

POSES = ("from F", "from H, the first pose", "from H, the better one")
METHODS = ("ours", "poselib:1", "poselib:2", "poselib:3", "usac_accurate:1", "usac_magsac:0.5")
CONFIGURATION = """Kinds of image pairs: confusion tables of `classify` and of COLMAP's rule, on the same matches.

Photographs: each as a plane, looked around in, copied, cropped, and beside another one. Every second photograph is for
tuning (--tuning), the others for the claim. Real and rendered pairs: --root, --rendered. SIFT, ratio 0.8, one match a
location, P(inlier) from frame consistency, noise of matches.

python -m scripts.benchmark pair_types --photographs DATA/photos --root DATA/Strecha
"""
# Scenes, and rendered families, whose depth and baseline every pair sees.
GENERAL = {"castle-P19", "fountain-P11", "Herz-Jesus-P8", "sacre_coeur", "00", "driving", "orbit"}
TIMED_FIELDS = ("x0", "x1", "mask", "ratio", "prior", "noise", "key", "size0", "size1", "K0", "K1")
COLMAP = {
    "CALIBRATED": "general", "UNCALIBRATED": "general", "PLANAR": "planar", "PANORAMIC": "rotation",
    "PLANAR_OR_PANORAMIC": "planar", "WATERMARK": "identical", "DEGENERATE": "unrelated", "UNDEFINED": "unrelated",
}  # fmt: skip


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "homography", run, __doc__, seeds=3)
    add_options(parser, required=True)
    parser.add_argument("--methods", nargs="+", default=METHODS, help="NAME:THRESHOLD or ours:KEY=VALUE,...")
    parser.add_argument("--kinds", nargs="+", default=["warped", "hard", "views"], choices=["warped", "hard", "views"])
    parser.add_argument("--warps", type=int, default=1, help="pairs of each kind and photograph")
    parser.add_argument("--limit", type=int, help="photographs at most")
    parser = add_command(commands, "pair_types", run_pair_types, CONFIGURATION)
    add_options(parser, required=False)
    pairs.add_match_options(parser)
    parser.add_argument("--colmap", nargs="*", type=float, default=[4.0, 1.0], help="COLMAP's thresholds, px")
    parser.add_argument("--unknown", action="store_true", help="without calibrations, by image sizes alone")
    parser.set_defaults(pruners=["ratio", "one_to_one", "frame_consistency", "match_noise"])


def run(arguments: argparse.Namespace) -> None:
    paths = paths_of(arguments)
    planes = [*(warped(paths, arguments.warps) if {"warped", "hard"} & set(arguments.kinds) else ()),
              *(views(paths, arguments.warps) if "views" in arguments.kinds else ())]  # fmt: skip
    items = [item for item in track(planes, "warping", console=console) if item.pair.family in arguments.kinds]
    results = Results(measure([Homography.of(word) for word in arguments.methods], items, arguments.seeds, Kept(None)))
    groups = {kind: own for kind, own in results.groups(results.all_pairs).items() if kind in results.families}
    records = results.records(groups, [*(f"AUC@{px} px" for px in (1, 3, 5)), "ms"], "method", ["AUC@1 px"])
    show([Sheet("homography", "AUC of the mean distance of points, in %", records)], arguments.table)


@dataclasses.dataclass(frozen=True)
class Homography(Measured):
    """An estimator of homographies."""

    name: str
    solve: Callable[[Correspondences, int], Array | None]
    identity: str = ""

    @classmethod
    def of(cls, word: str) -> Homography:
        """``ours:KEY=VALUE,...``, ``poselib:THRESHOLD`` or the name of an OpenCV method with its threshold."""
        name, _, setting = word.partition(":")
        if name == "ours":
            return cls(word, functools.partial(_ours, options(setting)))
        return cls(word, functools.partial(_peer, name, float(setting)))

    def figures(self, item: Item, seed: int) -> Row:
        """The mean error in pixels, infinite where there is no homography, and milliseconds."""
        assert isinstance(item, Plane)
        assert item.pair.H is not None
        start = time.process_time()
        H = self.solve(item.matches, seed)
        row: Row = {"ms": 1e3 * (time.process_time() - start), "corner_error": np.inf}
        if H is not None:
            apart = np.linalg.norm(mapped(H, item.points) - mapped(item.pair.H, item.points), axis=1)
            row["corner_error"] = float(apart.mean())
        return row


def estimated(c: Correspondences, seed: int = 0, **changed: Any) -> Estimate:
    """Our homography of a pair."""
    given: dict[str, Any] = {name: getattr(c, name) for name in ("mask", "ratio", "prior", "noise", "key")}
    return find_homography(c.x0, c.x1, seed=seed, **given, **changed)


def _ours(changed: dict[str, Any], c: Correspondences, seed: int) -> Array | None:
    estimate = estimated(c, seed, **changed)
    return estimate.H[0].numpy() if bool(estimate.ok[0]) else None


def _peer(name: str, threshold: float, c: Correspondences, seed: int) -> Array | None:
    """Of PoseLib, or by a method of OpenCV."""
    x0, x1 = points(c)
    if name == "poselib":
        import poselib

        return np.asarray(poselib.estimate_homography(x0, x1, {"max_reproj_error": threshold, "seed": seed}, {})[0])
    cv2.setRNGSeed(seed)
    if len(x0) < 4:
        return None
    H, _ = cv2.findHomography(x0, x1, getattr(cv2, name.upper()), threshold, maxIters=2000, confidence=0.9999)
    return None if H is None else np.asarray(H)


def run_pair_types(arguments: argparse.Namespace) -> None:
    items: list[Item] = []
    if arguments.photographs:
        items += track(list(kinds(paths_of(arguments))), "warping", console=console)
    if pairs.named(arguments):
        items += real(arguments)
    methods: dict[str, Callable[[Correspondences], str]] = {"fmtorch": Ours(not arguments.unknown)}
    methods |= {f"COLMAP, {px:g} px": functools.partial(by_colmap, px) for px in arguments.colmap}
    verdicts = {
        name: [verdict(item.matches) for item in track(items, name, console=console, transient=True)]
        for name, verdict in methods.items()
    }
    show([kinds_sheet(items, verdicts), pose_sheet(items, verdicts["fmtorch"])], arguments.table)
    print(time_line([item.matches for item in items]))


def real(arguments: argparse.Namespace) -> list[Item]:
    """Pairs of data sets with their cameras; of scenes of depth they are general."""
    items = []
    for item in pairs.matched(arguments):
        pair, outcome = item.pair, item.outcome
        if pair.K0 is not None and pair.K1 is not None and outcome is not None and outcome.correspondences is not None:
            item.facts["truth"] = "general" if {pair.scene, pair.family} & GENERAL else ""
            items.append(item)
    return items


class Ours:
    """`classify` after F, which has the exact cameras where they are known."""

    def __init__(self, known: bool) -> None:
        estimator = presets.build("estimator", "fmtorch")
        self.known, self.estimator = known, KnownCameras(estimator) if known else estimator

    def __call__(self, c: Correspondences) -> str:
        exact = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]], dtype=torch.float64)
        c = c.replace(focal=exact) if self.known else c.replace(K0=None, K1=None)
        return str(classify(c, self.estimator(c, 0), seed=0).names[0])


def by_colmap(threshold: float, c: Correspondences) -> str:
    """COLMAP's two-view geometry of calibrated cameras at a threshold of so many pixels."""
    known: Any = ((c.K0, c.size0), (c.K1, c.size1))
    first, second = (
        colmap.Camera(K[0].double().numpy(), number=number, size=(int(size[0, 0]), int(size[0, 1])))
        for number, (K, size) in enumerate(known)
    )
    geometry = colmap.two_view_geometry(*points(c), (first, second), colmap.two_view_options(threshold, 0))
    return COLMAP[geometry.configuration]


def kinds_sheet(items: Sequence[Item], verdicts: dict[str, list[str]]) -> Sheet:
    """How many pairs of each group each method calls what."""
    records: list[Record] = []
    for name, said in verdicts.items():
        groups: dict[tuple[str, str], list[str]] = {}
        for item, kind in zip(items, said, strict=True):
            scene = "" if isinstance(item, Plane) else f"/{item.pair.scene}"
            groups.setdefault((item.pair.family + scene, item.facts["truth"]), []).append(kind)
        for (group, truth), own in groups.items():
            line: Record = {"method": name, "pairs of": group, "truth": truth, "pairs": len(own)}
            line |= {kind: own.count(kind) for kind in PAIR_TYPES}
            records.append(line | {"right, %": f"{100 * own.count(truth) / len(own):.1f}" if truth else ""})
    return Sheet("kinds", "Kinds of pairs", records)


def pose_sheet(items: Sequence[Item], said: Sequence[str]) -> Sheet:
    """AUC of the pose error with known cameras, of pairs called general and of others, from F and from H."""
    groups: dict[tuple[str, str], list[Array]] = {}
    for item, kind in zip(items, said, strict=True):
        if item.pair.R is not None and item.pair.t is not None:
            motion = torch.from_numpy(item.pair.R), torch.from_numpy(item.pair.t)
            groups.setdefault((item.pair.family, kind), []).append(pose_errors(item.matches, *motion))
    records: list[Record] = []
    for (family, kind), errors in groups.items():
        line: Record = {"set": family, "kind": kind, "pairs": len(errors)}
        areas = 100 * metrics.pose_auc(torch.from_numpy(np.stack(errors, 1)))
        for name, own in zip(POSES, areas.tolist(), strict=True):
            line |= {f"{name} @{t}": f"{area:.1f}" for t, area in zip((5, 10, 20), own, strict=True)}
        records.append(line)
    return Sheet("poses", "AUC of the pose error, in %", records)


def pose_errors(c: Correspondences, R: torch.Tensor, t: torch.Tensor) -> Array:
    """Degrees (3,): of F's pose, of the first pose of H, and of the better one of both."""
    assert c.K0 is not None
    assert c.K1 is not None
    estimate = presets.build("estimator", "fmtorch")(c, 0)
    from_F = metrics.fundamental_pose_error(estimate.F, c.K0, c.K1, c.x0, c.x1, R[None], t[None], estimate.inliers)
    H = estimated(c)
    poses = poses_from_homography(H.F, c.K0, c.K1, c.x0.double(), c.x1.double(), H.inliers)
    seen = torch.where(poses.valid[..., None, None], poses.R, torch.nan)
    from_H = metrics.pose_error(seen, poses.t, R[None, None], t[None, None]).worst[0].nan_to_num(180.0)
    return np.array([float(from_F.worst), float(from_H[0]), float(from_H.min())])


def time_line(matches: Sequence[Correspondences]) -> str:
    """Milliseconds of processor time a pair, in one batch, of F and of `classify` beyond it."""
    chosen = matches[:: -(-len(matches) // 64)]
    c = collate([Correspondences(**{name: getattr(each, name) for name in TIMED_FIELDS}) for each in chosen])
    estimator = presets.build("estimator", "fmtorch")
    estimate = estimator(c, 0)
    classify(c, estimate)
    times = [time.process_time()]
    for call in (lambda: estimator(c, 0), lambda: classify(c, estimate)):
        call()
        times.append(time.process_time())
    ms = 1e3 * np.diff(times) / len(c)
    return f"{len(c)} pairs, median {int(c.count().median())} matches: F {ms[0]:.2f} ms, kinds {ms[1]:.2f} ms"
