"""Kinds of image pairs: confusion tables of `classify` and of COLMAP's rule, on the same matches.

Photographs: each as a plane, looked around in, copied, cropped, and beside another one (`configuration_pairs`). Every
second photograph is for tuning (--tuning), the others for the claim. Real and rendered pairs: --root, --rendered.
SIFT, ratio 0.8, one match a location, P(inlier) from frame consistency, noise of matches.

python -m scripts.benchmark configuration --photographs DATA/photos --root DATA/Strecha --folder kinds
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from rich.table import Table

from fmtorch import find_homography, metrics, presets
from fmtorch.core.files import replacing
from fmtorch.core.types import CONFIGURATIONS, Correspondences, collate
from fmtorch.estimators.external import colmap
from fmtorch.evaluation.pair_cameras import EXACT
from fmtorch.geometry import poses_from_homography
from fmtorch.two_view.known_cameras import KnownCameras
from fmtorch.two_view.pair_type import classify
from scripts.benchmark import matched
from scripts.benchmark.configuration_pairs import Case, photographs
from scripts.benchmark.matched import console

Array = NDArray[Any]
Verdict = Callable[[Case, int], str]
# Scenes, and rendered families, whose depth and baseline every pair sees.
GENERAL = {"castle-P19", "fountain-P11", "Herz-Jesus-P8", "sacre_coeur", "00", "driving", "orbit"}
TIMED_FIELDS = ("x0", "x1", "mask", "quality", "prior", "noise", "key", "size0", "size1", "K0", "K1")
COLMAP = {
    "CALIBRATED": "general", "UNCALIBRATED": "general", "PLANAR": "planar", "PANORAMIC": "rotation",
    "PLANAR_OR_PANORAMIC": "planar", "WATERMARK": "identical", "DEGENERATE": "unrelated", "UNDEFINED": "unrelated",
}  # fmt: skip


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("configuration", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=Path, help="a folder of photographs")
    parser.add_argument("--tuning", action="store_true", help="the photographs for choosing constants")
    matched.add_arguments(parser)
    parser.add_argument("--folder", type=Path, help="keeps matches from run to run")
    parser.add_argument("--colmap", nargs="*", type=float, default=[4.0, 1.0], help="COLMAP's thresholds, px")
    parser.add_argument("--unknown", action="store_true", help="without calibrations, by image sizes alone")
    parser.set_defaults(run=run, pruners=["ratio", "one_to_one", "frame_consistency", "match_noise"])


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    cases = []
    if arguments.photographs:
        paths = sorted(p for p in arguments.photographs.iterdir() if p.suffix in (".jpg", ".png"))
        paths = paths[(0 if arguments.tuning else 1) :: 2][: arguments.limit]
        name = f"photographs-{'tuning' if arguments.tuning else 'claim'}-{len(paths)}"
        cases += _kept(arguments.folder, name, lambda: list(track(photographs(paths), "warping", 5 * len(paths))))
    if arguments.root or arguments.rendered:
        name = "-".join([*(Path(r).name for r in arguments.root), arguments.rendered or "", str(arguments.limit)])
        cases += _kept(arguments.folder, name, lambda: real(arguments))
    methods: dict[str, Verdict] = {"fmtorch": Ours(not arguments.unknown)}
    methods |= {f"COLMAP, {px:g} px": _colmap(px) for px in arguments.colmap}
    verdicts = {
        name: [verdict(case, 0) for case in track(cases, name, console=console)] for name, verdict in methods.items()
    }
    report(cases, verdicts)
    pose_report(cases, verdicts["fmtorch"])
    time_report(cases)


def _kept(folder: Path | None, name: str, make: Callable[[], list[Case]]) -> list[Case]:
    """The cases, kept in the folder where there is one."""
    if folder is None:
        return make()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.pt"
    if not path.exists():
        plain = [({k: v for k, v in vars(c.matches).items() if v is not None}, *c[1:]) for c in make()]
        with replacing(path) as temporary:
            torch.save(plain, temporary)
    return [Case(Correspondences(**fields), *rest) for fields, *rest in torch.load(path, weights_only=True)]


def real(arguments: argparse.Namespace) -> list[Case]:
    """Pairs of data sets with their cameras; of scenes of depth they are general."""
    cases = []
    for pair, c in matched.load(arguments):
        if pair.K0 is None or pair.K1 is None:
            continue
        K = [torch.from_numpy(k)[None] for k in (pair.K0, pair.K1)]
        known = pair.scene in GENERAL or pair.family in GENERAL
        group = pair.family if arguments.rendered else f"{pair.family}/{pair.scene}"
        motion = None if pair.R is None or pair.t is None else (torch.from_numpy(pair.R), torch.from_numpy(pair.t))
        truth = "general" if known else ""
        cases.append(Case(c.replace(K0=K[0], K1=K[1]), truth, group, pair.identity, motion))
    return cases


class Ours:
    """`classify` after F, which has the exact cameras where they are known."""

    def __init__(self, known: bool, **options: Any) -> None:
        self.known, self.options = known, options
        estimator = presets.build("estimator", "fmtorch")
        self.estimator = KnownCameras(estimator) if known else estimator

    def __call__(self, case: Case, seed: int) -> str:
        c = case.matches
        c = c.replace(focal=torch.tensor([[EXACT, EXACT]]).double()) if self.known else c.replace(K0=None, K1=None)
        return classify(c, self.estimator(c, seed), seed=seed, **self.options).names[0]


def _colmap(threshold: float) -> Verdict:
    """COLMAP's two-view geometry of calibrated cameras at a threshold of so many pixels."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value

    def verdict(case: Case, seed: int) -> str:
        c = case.matches
        assert c.K0 is not None
        assert c.K1 is not None
        x0, x1 = (x[0][c.mask[0]].double().numpy() for x in (c.x0, c.x1))
        assert c.size0 is not None
        assert c.size1 is not None
        first, second = (
            colmap.Camera(K[0].double().numpy(), number=i, size=(int(size[0, 0]), int(size[0, 1])))
            for i, (K, size) in enumerate(((c.K0, c.size0), (c.K1, c.size1)))
        )
        geometry = colmap.two_view_geometry(x0, x1, (first, second), colmap.two_view_options(threshold, seed))
        return COLMAP[geometry.configuration]

    return verdict


def report(cases: list[Case], verdicts: dict[str, list[str]]) -> None:
    groups = list(dict.fromkeys((case.group, case.truth) for case in cases))
    for name, kinds in verdicts.items():
        table = Table(title=name)
        for column in ("pairs of", "truth", "pairs", *CONFIGURATIONS, "right, %"):
            table.add_column(column, justify="left" if column in ("pairs of", "truth") else "right")
        for group, truth in groups:
            own = [kind for kind, case in zip(kinds, cases, strict=True) if case.group == group]
            right = f"{100 * own.count(truth) / len(own):.1f}" if truth else ""
            table.add_row(group, truth, str(len(own)), *(str(own.count(kind)) for kind in CONFIGURATIONS), right)
        console.print(table)


def pose_report(cases: list[Case], kinds: list[str]) -> None:
    """AUC of the pose error with known cameras, of pairs called general and of others, from F and from H."""
    table = Table(title="pose AUC@5/10/20 degrees, %")
    for column in ("pairs of", "kind", "pairs", "from F", "from H, the first pose", "from H, the better one"):
        table.add_column(column, justify="left" if column in ("pairs of", "kind") else "right")
    keys = [(case.group, kind) for case, kind in zip(cases, kinds, strict=True) if case.motion is not None]
    for group, kind in dict.fromkeys(keys):
        own = [case for case, k in zip(cases, kinds, strict=True) if (case.group, k) == (group, kind)]
        areas = 100 * metrics.pose_auc(torch.from_numpy(np.stack([_pose_errors(case) for case in own], 1)))
        table.add_row(group, kind, str(len(own)), *("/".join(f"{area:.1f}" for area in row) for row in areas.tolist()))
    console.print(table)


def _pose_errors(case: Case) -> Array:
    """Degrees (3,): of F's pose, of the first pose of H, and of the better one of both."""
    c, motion = case.matches, case.motion
    assert c.K0 is not None
    assert c.K1 is not None
    assert motion is not None
    R, t = (a[None] for a in motion)
    estimate = presets.build("estimator", "fmtorch")(c, 0)
    from_F = metrics.fundamental_pose_error(estimate.F, c.K0, c.K1, c.x0, c.x1, R, t, estimate.inliers)
    H = find_homography(c.x0, c.x1, mask=c.mask, quality=c.quality, prior=c.prior, noise=c.noise, key=c.key)
    poses = poses_from_homography(H.F, c.K0, c.K1, c.x0.double(), c.x1.double(), H.inliers)
    seen = torch.where(poses.valid[..., None, None], poses.R, torch.nan)
    from_H = metrics.pose_error(seen, poses.t, R[:, None], t[:, None]).worst[0].nan_to_num(180.0)
    return np.array([float(from_F.worst), float(from_H[0]), float(from_H.min())])


def time_report(cases: list[Case]) -> None:
    """Milliseconds of processor time a pair, in one batch, of F and of `classify` beyond it."""
    fields = [{name: getattr(case.matches, name) for name in TIMED_FIELDS} for case in cases[:: -(-len(cases) // 64)]]
    c = collate([Correspondences(**each) for each in fields])
    estimator = presets.build("estimator", "fmtorch")
    estimate = estimator(c, 0)
    milliseconds = []
    for function in (lambda: estimator(c, 0), lambda: classify(c, estimate)):
        function()
        start = time.process_time()
        function()
        milliseconds.append((time.process_time() - start) / len(c) * 1e3)
    count = int(c.count().median())
    console.print(f"{len(c)} pairs, median {count} matches: F {milliseconds[0]:.2f} ms, kinds {milliseconds[1]:.2f} ms")
