"""How many of the pairs that can be matched `pairs=similar:N` proposes, all scenes mixed in one folder."""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from fmtorch import presets
from fmtorch.data import read_image
from fmtorch.features.vlad import Codebook, codebook, descriptor_kind, load_codebook, local_descriptors, vlad
from fmtorch.pipeline.build import load_pipeline
from fmtorch.pipeline.folder import similar_pairs
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.pipeline.two_images import describe

Pair = frozenset[Path]


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("similar", help=__doc__)
    parser.add_argument("--root", type=Path, nargs="+", required=True, help="folders in the layout of fmbench")
    parser.add_argument("--pipeline", default="sift_fmtorch")
    parser.add_argument("--codebook", type=Path, help="another one than the package's")
    parser.add_argument("--count", type=int, nargs="+", default=[5, 10, 20])
    parser.set_defaults(run=run)


def images_of(root: Path) -> dict[tuple[str, int], Path]:
    """The images of a set, by scene and number."""
    return {(path.parents[1].name, int(path.stem)): path for path in sorted(root.glob("*/Images/*"))}


def overlapping(root: Path) -> Iterator[tuple[str, Pair]]:
    """The pairs of a set with a true F, with their scene: those that `fmtorch pairs` would keep."""
    images = images_of(root)
    scenes = (root / "pairs_which_dataset.txt").read_text().split()
    lines = (root / "pairs_with_gt.txt").read_text().splitlines()
    for scene, line in zip((scene.strip("/") for scene in scenes), lines, strict=True):
        yield f"{root.name}/{scene}", frozenset(images[scene, int(number)] for number in line.split()[:2])


def vectors_of(
    images: list[Path], pipeline: Pipeline, options: Any, book: Codebook | None
) -> tuple[torch.Tensor, float]:
    """The vectors of images, and the seconds of processor time they took once there were features."""
    kind = descriptor_kind(options)
    book = codebook(kind) if book is None else book
    vectors, seconds = [], 0.0
    for image in images:
        features = describe(pipeline, read_image(image), 1600).features
        start = time.process_time()
        vectors.append(vlad(local_descriptors(features.descriptors, kind), book))
        seconds += time.process_time() - start
    return torch.stack(vectors), seconds


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    console = Console()
    pairs = {pair: scene for root in arguments.root for scene, pair in overlapping(root)}
    images = [path for root in sorted(arguments.root) for path in images_of(root).values()]
    pipeline: Pipeline = load_pipeline(arguments.pipeline)
    options = (presets.pipeline_stages(arguments.pipeline) or {})["features"]
    book = None if arguments.codebook is None else load_codebook(arguments.codebook)
    vectors, seconds = vectors_of(images, pipeline, options, book)
    total = Counter(pairs.values())
    console.print(f"{len(images)} images, {len(pairs)} overlapping pairs of {len(images) * (len(images) - 1) // 2}; "
                  f"{1e3 * seconds / len(images):.1f} s for a thousand images once they are described")  # fmt: skip
    for count in arguments.count:
        start = time.process_time()
        proposed = {frozenset(pair) for pair in similar_pairs(images, vectors, count)}
        seconds = time.process_time() - start
        hits = Counter(scene for pair, scene in pairs.items() if pair in proposed)
        by_scene = ", ".join(f"{scene} {100 * hits[scene] / of:.0f}" for scene, of in total.items())
        inside = sum(len({path.parent for path in pair}) == 1 for pair in proposed)
        console.print(
            f"N = {count}: {len(proposed)} pairs, {100 * inside / len(proposed):.0f} % within a scene, recall "
            f"{100 * hits.total() / len(pairs):.1f} % ({by_scene}), {seconds:.2f} s", soft_wrap=True, highlight=False,
        )  # fmt: skip
