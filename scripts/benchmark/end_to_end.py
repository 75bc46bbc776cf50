"""Whole pipelines by stage against the same stages written with OpenCV's and kornia's calls, one thread each.

python -m scripts.benchmark end_to_end --root DATA/Strecha --limit 6 --markdown docs/appendix/features.md

Ours and the peer take turns at each pair; medians of processor time are shown. The peer of `hesaffnet_gms` has kornia's
Hessian detector, AffNet and HardNet (the same networks with random weights, which cost the same) for as many features
as ours found, and no GMS, which neither library has; that of `sift_fmtorch` has USAC_MAGSAC.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import kornia.feature as KF
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from fmtorch.core.stages import pruned
from fmtorch.data import ImagePair, read_image
from fmtorch.data.images import to_grey
from fmtorch.evaluation.run import select
from fmtorch.pipeline.pipeline import STAGES, Pipeline
from scripts.benchmark.features import kornia_hesaffnet
from scripts.benchmark.matched import add_set_arguments, console, sets_of
from scripts.benchmark.sheet import Sheet, put
from scripts.benchmark.specs import pipeline_of

MARKER = "end to end"
RATIO = 0.8
Seconds = dict[str, float]
Image = NDArray[np.uint8]
Peer = Callable[[Image, Image, int], Seconds]


class Clock:
    """Seconds of processor time between one stage and the next."""

    def __init__(self) -> None:
        self.seconds: Seconds = dict.fromkeys(STAGES, 0.0)
        self.last = time.process_time()

    def stage(self, name: str) -> None:
        """What was computed since the last call belongs to this stage."""
        now = time.process_time()
        self.seconds[name] += now - self.last
        self.last = now


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("end_to_end", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_set_arguments(parser, "pairs of each family at most, chosen by hash")
    parser.add_argument("--pipelines", nargs="*", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--markdown", type=Path, help=f"put the table between the marks `{MARKER}` of this file")
    parser.set_defaults(run=run)


@torch.no_grad()
def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    pairs = select([dataset[i] for dataset in sets_of(arguments) for i in range(len(dataset))], arguments.limit)
    lines: list[list[str]] = []
    for name in arguments.pipelines:
        title, peer = PEERS[name]
        ours, theirs = measured(pipeline_of(name, "cache=off"), peer, pairs)
        lines += [row(f"`{name}`", ours), row(title, theirs)]
        ratio = np.median([sum(b.values()) / sum(a.values()) for a, b in zip(ours, theirs, strict=True)])
        lines[-1].append(f"{ratio:.1f}")
        lines[-2].append("1.0")
    families = ", ".join(sorted({pair.family for pair in pairs}))
    title = f"Median milliseconds a pair, {len(pairs)} pairs of {families}"
    sheet = Sheet(title, ["", *STAGES, "all", "time / ours"], lines)
    console.print(sheet.terminal())
    if arguments.markdown:
        put(arguments.markdown, [sheet], MARKER)


def measured(pipeline: Pipeline, peer: Peer, pairs: list[ImagePair]) -> tuple[list[Seconds], list[Seconds]]:
    """Seconds of each stage for each pair, of ours and of the peer; the first pair is run once before."""
    ours, theirs = [], []
    for number, pair in enumerate(track([pairs[0], *pairs], "measuring", console=console, transient=True)):
        images = read_image(pair.image0), read_image(pair.image1)
        seconds, features = own(pipeline, pair, *images)
        other = peer(*images, features)
        if number:
            ours.append(seconds)
            theirs.append(other)
    return ours, theirs


def own(pipeline: Pipeline, pair: ImagePair, image0: Image, image1: Image) -> tuple[Seconds, int]:
    """Of our pipeline; and how many features an image has on average."""
    clock = Clock()
    features0, features1 = pipeline.extractor(image0), pipeline.extractor(image1)
    clock.stage("features")
    c = pipeline.matcher(features0, features1)
    clock.stage("matching")
    for pruner in pipeline.pruners_of(pair.family).values():
        c = pruned(pruner, c, lambda _: pipeline.images(pair)).compact()
    clock.stage("pruning")
    pipeline.estimator(c, 0)
    clock.stage("estimation")
    return clock.seconds, (len(features0) + len(features1)) // 2


def opencv(method: int, threshold: float) -> Peer:
    """SIFT, brute-force matching, ratio test and an estimator of OpenCV's."""

    def call(image0: Image, image1: Image, features: int) -> Seconds:
        clock, sift = Clock(), cv2.SIFT.create(8000)
        (k0, d0), (k1, d1) = (sift.detectAndCompute(to_grey(image), None) for image in (image0, image1))
        clock.stage("features")
        neighbors = cv2.BFMatcher(cv2.NORM_L2).knnMatch(d0, d1, 2)
        clock.stage("matching")
        kept = [two[0] for two in neighbors if len(two) == 2 and two[0].distance < RATIO * two[1].distance]
        x0 = np.array([k0[match.queryIdx].pt for match in kept], np.float64)
        x1 = np.array([k1[match.trainIdx].pt for match in kept], np.float64)
        clock.stage("pruning")
        if len(kept) >= 8:
            cv2.findFundamentalMat(x0, x1, method, threshold, 0.9999, 10000)
        clock.stage("estimation")
        return clock.seconds

    return call


def kornia(image0: Image, image1: Image, features: int) -> Seconds:
    """kornia's HesAffNet and matcher with the ratio test, OpenCV's LMedS."""
    hesaffnet = kornia_hesaffnet(features)
    clock = Clock()
    extracted = [hesaffnet(torch.from_numpy(to_grey(image))[None, None].float() / 255) for image in (image0, image1)]
    clock.stage("features")
    _, matches = KF.match_snn(extracted[0][2][0], extracted[1][2][0], RATIO)
    clock.stage("matching")
    x0, x1 = (extracted[i][0][0, matches[:, i], :, 2].double().numpy() for i in (0, 1))
    clock.stage("pruning")
    if len(matches) >= 8:
        cv2.findFundamentalMat(x0, x1, cv2.FM_LMEDS, 1.0, 0.9999, 10000)
    clock.stage("estimation")
    return clock.seconds


def row(name: str, seconds: list[Seconds]) -> list[str]:
    """The medians of each stage and of their sum, in milliseconds."""
    stages = [np.median([each[stage] for each in seconds]) for stage in STAGES]
    return [name, *(f"{1e3 * s:.1f}" for s in stages), f"{1e3 * np.median([sum(s.values()) for s in seconds]):.0f}"]


PEERS: dict[str, tuple[str, Peer]] = {
    "sift_ratio estimator=lmeds_eight_point": ("OpenCV: SIFT, BFMatcher, FM_LMEDS", opencv(cv2.FM_LMEDS, 1.0)),
    "sift_fmtorch": ("OpenCV: SIFT, BFMatcher, USAC_MAGSAC", opencv(cv2.USAC_MAGSAC, 0.25)),
    "hesaffnet_gms": ("kornia: HesAffNet, match_snn; OpenCV: FM_LMEDS", kornia),
}
