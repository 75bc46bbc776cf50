"""Where the time of images goes: processor milliseconds by stage, and pairs proposed by the likeness of images."""

import argparse
import functools
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import kornia.feature as KF
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from fmtorch import data, presets
from fmtorch.core.stages import pruned
from fmtorch.data import ImagePair, read_image, to_grey
from fmtorch.features import ImagePyramid, LocalFeature
from fmtorch.features.vlad import codebook, descriptor_kind, local_descriptors, vlad
from fmtorch.pipeline.folder import similar_pairs
from fmtorch.pipeline.pipeline import STAGES, Pipeline
from fmtorch.pipeline.two_images import describe
from fmtorch.scenes.surfaces import photograph
from scripts.benchmark import pairs
from scripts.benchmark.methods import pipeline_of
from scripts.benchmark.runner import add_command, console
from scripts.benchmark.tables import Record, Sheet, show

Image = NDArray[np.uint8]
Seconds = dict[str, float]
Peer = Callable[[Image, Image, int], Seconds]
PARTS = ("detection", "shape", "orientation", "description")
RATIO = 0.8
FEATURES = """Where the time of an image's features goes: processor milliseconds by stage, of presets that take turns.

python -m scripts.benchmark features --image PHOTOGRAPH --size 1178 1766 --features hesaffnet hesaffnet_fast
"""
END_TO_END = """Whole pipelines by stage against the same stages written with OpenCV's and kornia's calls, in turn.

The peer of `hesaffnet_gms` has kornia's Hessian detector, AffNet and HardNet (the same networks with random weights,
which cost the same) for as many features as ours found, and no GMS, which neither library has.
"""
SIMILAR = "How many of the pairs that can be matched `pairs=similar:N` proposes, all scenes mixed in one folder."


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "features", run_features, FEATURES)
    parser.add_argument("--image", type=Path, help="default: a photograph of scikit-image")
    parser.add_argument("--size", type=int, nargs=2, default=(1024, 1536), help="the image is resized to (h, w)")
    parser.add_argument("--features", nargs="+", default=["hesaffnet", "hesaffnet_fast"], help="of conf/features")
    parser.add_argument("--repeats", type=int, default=7)
    parser = add_command(commands, "end_to_end", run_end_to_end, END_TO_END)
    pairs.add_set_options(parser)
    parser.add_argument("--pipelines", nargs="*", default=list(PEERS), choices=list(PEERS))
    parser = add_command(commands, "similar", run_similar, SIMILAR)
    parser.add_argument("--root", type=Path, nargs="+", required=True, help="folders in the layout of fmbench")
    parser.add_argument("--pipeline", default="sift_fmtorch")
    parser.add_argument("--count", type=int, nargs="+", default=[5, 10, 20])


class Clock:
    """Seconds of processor time between one stage and the next."""

    def __init__(self, stages: tuple[str, ...]) -> None:
        self.seconds, self.last = dict.fromkeys(stages, 0.0), time.process_time()

    def stage(self, name: str) -> None:
        """What was computed since the last call belongs to this stage."""
        self.seconds[name] += time.process_time() - self.last
        self.last = time.process_time()


def medians(seconds: list[Seconds]) -> Record:
    totals = [{**each, "all": sum(each.values())} for each in seconds]
    return {f"{stage}, ms": f"{1e3 * np.median([each[stage] for each in totals]):.1f}" for stage in totals[0]}


@torch.no_grad()
def run_features(arguments: argparse.Namespace) -> None:
    h, w = arguments.size
    image = photograph("chelsea.png") if arguments.image is None else read_image(arguments.image)
    image = np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_CUBIC), np.uint8)
    features = {name: presets.build("features", name) for name in arguments.features}
    turns = [{name: by_stage(each, image) for name, each in features.items()} for _ in range(arguments.repeats + 1)]
    records: list[Record] = [{"features": name, **medians([turn[name] for turn in turns[1:]])} for name in features]
    show([Sheet("stages", f"{w} x {h}", records)], arguments.table)


def by_stage(feature: LocalFeature, image: Image) -> Seconds:
    """Seconds of processor time of each stage, patches included where they are cut; 0 for a stage that is absent."""
    clock = Clock(PARTS)
    lafs, _ = feature.detector.detect(image)
    pyramid = ImagePyramid(to_grey(image))
    clock.stage("detection")
    for stage, step in (("shape", feature.shape), ("orientation", feature.orientation)):
        if step is not None:
            lafs = step(pyramid, lafs)
            clock.stage(stage)
    feature.describe(image, lafs)
    clock.stage("description")
    return clock.seconds


@torch.no_grad()
def run_end_to_end(arguments: argparse.Namespace) -> None:
    every = pairs.pairs_of(arguments)
    records: list[Record] = []
    for name in arguments.pipelines:
        (title, peer), pipeline = PEERS[name], pipeline_of(name, "cache=off")
        ours: list[Seconds] = []
        theirs: list[Seconds] = []
        for pair in track([every[0], *every], name, console=console, transient=True):
            images = read_image(pair.image0), read_image(pair.image1)
            seconds, features = own_stages(pipeline, pair, *images)
            ours.append(seconds)
            theirs.append(peer(*images, features))
        ratio = np.median([sum(b.values()) / sum(a.values()) for a, b in zip(ours[1:], theirs[1:], strict=True)])
        records.append({"pipeline": name, **medians(ours[1:]), "time / ours": "1.0"})
        records.append({"pipeline": title, **medians(theirs[1:]), "time / ours": f"{ratio:.1f}"})
    show([Sheet("end_to_end", f"Medians of {len(every)} pairs", records)], arguments.table)


def own_stages(pipeline: Pipeline, pair: ImagePair, image0: Image, image1: Image) -> tuple[Seconds, int]:
    """Of our pipeline; and how many features an image has on average."""
    clock = Clock(STAGES)
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


def opencv_stages(method: int, threshold: float, image0: Image, image1: Image, features: int) -> Seconds:
    """SIFT, brute-force matching, ratio test and an estimator of OpenCV's."""
    clock, sift = Clock(STAGES), cv2.SIFT.create(8000)
    (k0, d0), (k1, d1) = (sift.detectAndCompute(to_grey(image), None) for image in (image0, image1))
    clock.stage("features")
    neighbors = cv2.BFMatcher(cv2.NORM_L2).knnMatch(d0, d1, 2)
    clock.stage("matching")
    kept = [two[0] for two in neighbors if len(two) == 2 and two[0].distance < RATIO * two[1].distance]
    x0 = np.array([k0[match.queryIdx].pt for match in kept], np.float64)
    x1 = np.array([k1[match.trainIdx].pt for match in kept], np.float64)
    return _estimated(clock, x0, x1, method, threshold)


def _estimated(clock: Clock, x0: NDArray[Any], x1: NDArray[Any], method: int, threshold: float) -> Seconds:
    """The seconds of a peer when it has matches, F included."""
    clock.stage("pruning")
    if len(x0) >= 8:
        cv2.findFundamentalMat(x0, x1, method, threshold, 0.9999, 10000)
    clock.stage("estimation")
    return clock.seconds


def kornia_stages(image0: Image, image1: Image, features: int) -> Seconds:
    """kornia's HesAffNet and matcher with the ratio test, OpenCV's LMedS."""
    shape = KF.LAFAffNetShapeEstimator(False, preserve_orientation=False)
    hessian = KF.BlobHessian()
    detector = KF.ScaleSpaceDetector(features, resp_module=hessian, aff_module=shape, ori_module=KF.LAFOrienter(32))
    hesaffnet = KF.LocalFeature(detector, KF.LAFDescriptor(KF.HardNet(False))).eval()
    clock = Clock(STAGES)
    extracted = [hesaffnet(torch.from_numpy(to_grey(image))[None, None].float() / 255) for image in (image0, image1)]
    clock.stage("features")
    _, matches = KF.match_snn(extracted[0][2][0], extracted[1][2][0], RATIO)
    clock.stage("matching")
    x0, x1 = (extracted[i][0][0, matches[:, i], :, 2].double().numpy() for i in (0, 1))
    return _estimated(clock, x0, x1, cv2.FM_LMEDS, 1.0)


LMEDS, MAGSAC = (functools.partial(opencv_stages, *of) for of in ((cv2.FM_LMEDS, 1.0), (cv2.USAC_MAGSAC, 0.25)))
PEERS: dict[str, tuple[str, Peer]] = {
    "sift_ratio estimator=lmeds_eight_point": ("OpenCV: SIFT, BFMatcher, FM_LMEDS", LMEDS),
    "sift_fmtorch": ("OpenCV: SIFT, BFMatcher, USAC_MAGSAC", MAGSAC),
    "hesaffnet_gms": ("kornia: HesAffNet, match_snn; OpenCV: FM_LMEDS", kornia_stages),
}


def run_similar(arguments: argparse.Namespace) -> None:
    roots = sorted(arguments.root)
    paths = [path for root in roots for path in sorted(root.glob("*/Images/*"))]
    sets = [data.load("fmbench", root=root) for root in roots]  # pairs with a true F, which `fmtorch pairs` would keep
    true = [pair for own in sets for pair in own]
    overlapping = {frozenset((p.image0.path, p.image1.path)): f"{p.family}/{p.scene}" for p in true}
    pipeline = pipeline_of(arguments.pipeline)
    kind = descriptor_kind((presets.pipeline_stages(arguments.pipeline) or {})["features"])
    book = codebook(kind)
    described = [describe(pipeline, read_image(path), 1600).features.descriptors for path in paths]
    start = time.process_time()
    vectors = torch.stack([vlad(local_descriptors(descriptors, kind), book) for descriptors in described])
    seconds = (time.process_time() - start) / len(paths)
    print(f"{len(paths)} images; {1e3 * seconds:.1f} s for a thousand once described")
    proposed = {n: {frozenset(pair) for pair in similar_pairs(paths, vectors, n)} for n in arguments.count}
    records: list[Record] = []
    for scene, count in [*Counter(overlapping.values()).items(), ("all", len(overlapping))]:
        line: Record = {"scene": scene, "overlapping pairs": count}
        for n, chosen in proposed.items():
            hits = sum(pair in chosen for pair, of in overlapping.items() if scene in (of, "all"))
            line |= {f"similar:{n}, recall, %": f"{100 * hits / count:.0f}", f"similar:{n}, pairs": len(chosen)}
        records.append(line)
    show([Sheet("similar", f"Pairs proposed, of {len(paths) * (len(paths) - 1) // 2}", records)], arguments.table)
