"""Local features per image against kornia's and OpenCV's, one thread each, CPU seconds of interleaved runs."""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import kornia.feature as KF
import numpy as np
import torch
from rich.console import Console

from fmtorch.core.types import Features
from fmtorch.data import read_image
from fmtorch.data.images import to_grey
from fmtorch.features import SIFT, DominantGradient, HessianDetector, ImagePyramid, PatchSIFT, local_feature
from fmtorch.matching import NearestNeighborMatcher
from fmtorch.scenes.textures import photograph
from fmtorch.training.onnx_export import lay_out

OURS = "ours"


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("features", help=__doc__)
    parser.add_argument("--image", type=Path, help="default: a photograph of scikit-image")
    parser.add_argument("--size", type=int, nargs=2, default=(1024, 1536), help="the image is resized to (h, w)")
    parser.add_argument("--features", type=int, default=2048)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--networks", type=Path, help="folder with affnet.onnx and hardnet.onnx instead of random ones")
    parser.set_defaults(run=run)


@torch.no_grad()
def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    h, w = arguments.size
    picture = photograph("chelsea.png") if arguments.image is None else read_image(arguments.image)
    image = np.ascontiguousarray(cv2.resize(to_grey(picture), (w, h), interpolation=cv2.INTER_AREA), np.uint8)
    tensor = torch.from_numpy(image)[None, None].float() / 255
    n = arguments.features
    lafs = HessianDetector(n).detect(image)[0]
    pyramid = ImagePyramid(image)
    patches = pyramid.extract(lafs)
    blob = KF.ScaleSpaceDetector(n, resp_module=KF.BlobHessian())
    peer_orientation, peer_sift = KF.PatchDominantGradientOrientation(32), KF.SIFTDescriptor(32)
    dog = SIFT(max_features=n)
    dog_lafs, opencv = dog.detect(image)[0], cv2.SIFT.create(n)
    keypoints = opencv.detect(image)
    steps: dict[str, dict[str, Callable[[], object]]] = {
        "detection": {
            OURS: lambda: HessianDetector(n).detect(image), "kornia": lambda: blob(tensor),
            "SIFT": lambda: dog.detect(image),
        },
        "patches": {
            OURS: lambda: ImagePyramid(image).extract(lafs),
            "kornia": lambda: KF.extract_patches_from_pyramid(tensor, lafs[None]),
            "warpAffine": lambda: _warp_affine(image, lafs),
        },
        "orientation": {
            OURS: lambda: DominantGradient()(pyramid, lafs), "kornia": lambda: peer_orientation(patches),
        },
        "SIFT description": {
            OURS: lambda: PatchSIFT()(ImagePyramid(image), dog_lafs), "kornia": lambda: peer_sift(patches),
            "OpenCV": lambda: opencv.compute(image, keypoints),
        },
        "DSP-SIFT description": {OURS: lambda: PatchSIFT(smallest=1 / 6, largest=3.0, sizes=10)(pyramid, dog_lafs)},
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        own, peer = _hesaffnet(n, arguments.networks or Path(folder), random=arguments.networks is None)
        steps["HesAffNet"] = {OURS: lambda: own(image), "kornia": lambda: peer(image)}
        console = Console()
        console.print(f"{w} x {h}, {len(lafs)} features; CPU ms, medians of {arguments.repeats}")
        for step, runs in steps.items():
            medians, ratio = _compare(runs, arguments.repeats)
            summary = ", ".join(f"{name} {ms:.0f}" for name, ms in medians.items())
            console.print(f"{step}: {summary}" + ("" if ratio is None else f"; {ratio:.1f} times faster than kornia"))
        if arguments.networks is None:
            summary = ", ".join(f"{k} {_right_matches(f, image)}" for k, f in ((OURS, own), ("kornia", peer)))
            console.print(f"right matches with a view turned by 20 degrees, the same random networks: {summary}")


def _compare(runs: dict[str, Callable[[], object]], repeats: int) -> tuple[dict[str, float], float | None]:
    """Median CPU milliseconds of each, and the median over the rounds of kornia's over ours."""
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _, (name, function) in itertools.product(range(repeats), runs.items()):
        start = time.process_time()
        function()
        seconds[name].append(time.process_time() - start)
    ratio = np.median(np.divide(seconds["kornia"], seconds[OURS])) if "kornia" in runs else None
    return {name: 1e3 * float(np.median(s)) for name, s in seconds.items()}, None if ratio is None else float(ratio)


def _warp_affine(image: np.ndarray, lafs: torch.Tensor) -> None:
    """What a plain loop over the image itself costs; it aliases."""
    for laf in lafs.double().numpy():
        matrix = np.c_[laf[:, :2] / 16, laf[:, 2] - laf[:, :2].sum(1) * 31 / 32]
        cv2.warpAffine(image, matrix, (32, 32), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def kornia_hesaffnet(
    n: int, affine: torch.nn.Module | None = None, hardnet: torch.nn.Module | None = None
) -> torch.nn.Module:
    """kornia's Hessian, AffNet, dominant gradient and HardNet for n features; without networks random ones."""
    shape = affine or KF.LAFAffNetShapeEstimator(False, preserve_orientation=False)
    detector = KF.ScaleSpaceDetector(n, resp_module=KF.BlobHessian(), aff_module=shape, ori_module=KF.LAFOrienter(32))
    return KF.LocalFeature(detector, KF.LAFDescriptor(hardnet or KF.HardNet(False))).eval()


def _hesaffnet(n: int, folder: Path, random: bool) -> tuple[Callable[..., Features], Callable[..., Features]]:
    """Hessian + AffNet + dominant gradient + HardNet, ours and kornia's; with random weights of the same networks."""
    torch.manual_seed(0)
    affine, hardnet = KF.LAFAffNetShapeEstimator(False, preserve_orientation=False).eval(), KF.HardNet(False).eval()
    if random:
        normalized = torch.nn.Sequential(_Normalized(), affine.features, torch.nn.Flatten())
        for name, module in (("affnet", normalized), ("hardnet", hardnet)):
            torch.onnx.export(
                module, (torch.rand(4, 1, 32, 32),), str(folder / f"{name}.onnx"), input_names=["patches"],
                output_names=["values"], dynamic_axes={"patches": {0: "n"}, "values": {0: "n"}}, dynamo=False,
            )  # fmt: skip
            lay_out(folder / f"{name}.onnx")
    own = local_feature(
        "hessian",
        {"name": "hardnet", "network": str(folder / "hardnet.onnx")},
        shape={"name": "affnet", "network": str(folder / "affnet.onnx")},
        orientation="dominant_gradient",
        max_features=n,
    )
    extractor = kornia_hesaffnet(n, affine, hardnet)

    def peer(image: np.ndarray) -> Features:
        lafs, responses, descriptors = extractor(torch.from_numpy(image)[None, None].float() / 255)
        return Features(lafs[0], responses[0], descriptors[0], torch.tensor(image.shape))

    return own, peer


class _Normalized(torch.nn.Module):
    def forward(self, patches: torch.Tensor) -> torch.Tensor:
        mean, deviation = patches.mean((1, 2, 3), keepdim=True), patches.std((1, 2, 3), keepdim=True)
        return (patches - mean) / (deviation + 1e-6)


def _right_matches(extract: Callable[..., Features], image: np.ndarray) -> str:
    """How many nearest neighbours below the ratio 0.8 are within 3 px of the truth, of how many."""
    h, w = image.shape
    matrix = cv2.getRotationMatrix2D((w / 2, h / 2), 20, 0.9)
    c = NearestNeighborMatcher()(extract(image), extract(cv2.warpAffine(image, matrix, (w, h))))
    error = c.x0[0].numpy() @ matrix[:, :2].T + matrix[:, 2] - c.x1[0].numpy()
    assert c.quality is not None
    kept = (c.quality[0] < 0.8).numpy()
    return f"{int((np.linalg.norm(error[kept], axis=1) < 3).sum())} of {int(kept.sum())}"
