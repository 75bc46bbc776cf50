"""Where the time of an image's features goes: processor milliseconds by stage, of presets that take turns.

python -m scripts.benchmark stages --image PHOTOGRAPH --size 1178 1766 --features hesaffnet hesaffnet_fast

Medians of the repeats on one thread, after one run that opens the networks.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from fmtorch import presets
from fmtorch.data import read_image
from fmtorch.data.images import to_grey
from fmtorch.features import ImagePyramid, LocalFeature
from fmtorch.scenes.textures import photograph

STAGES = ("detection", "shape", "orientation", "description")


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("stages", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--image", type=Path, help="default: a photograph of scikit-image")
    parser.add_argument("--size", type=int, nargs=2, help="the image is resized to (h, w)")
    parser.add_argument("--features", nargs="+", default=["hesaffnet", "hesaffnet_fast"], help="of conf/features")
    parser.add_argument("--repeats", type=int, default=7)
    parser.set_defaults(run=run)


@torch.no_grad()
def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    image = photograph("chelsea.png") if arguments.image is None else read_image(arguments.image)
    if arguments.size is not None:
        h, w = arguments.size
        image = np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_CUBIC), np.uint8)
    features = {name: presets.build("features", name) for name in arguments.features}
    seconds: dict[str, list[dict[str, float]]] = {name: [] for name in features}
    for repeat in range(arguments.repeats + 1):
        for name, feature in features.items():
            spent = by_stage(feature, image)
            if repeat:
                seconds[name].append(spent)
    table = Table(f"{image.shape[1]} x {image.shape[0]}", *STAGES, "all (ms)")
    for name, rows in seconds.items():
        columns = [[row[stage] for row in rows] for stage in STAGES] + [[sum(row.values()) for row in rows]]
        table.add_row(name, *(f"{1e3 * float(np.median(column)):.0f}" for column in columns))
    Console().print(table)


def by_stage(feature: LocalFeature, image: np.ndarray) -> dict[str, float]:
    """Seconds of processor time of each stage, patches included where they are cut; 0 for a stage that is absent."""
    seconds, last = dict.fromkeys(STAGES, 0.0), time.process_time()

    def note(stage: str) -> None:
        nonlocal last
        now = time.process_time()
        seconds[stage] += now - last
        last = now

    lafs, _ = feature.detector.detect(image)
    pyramid = ImagePyramid(to_grey(image))
    note("detection")
    for stage, step in (("shape", feature.shape), ("orientation", feature.orientation)):
        if step is not None:
            lafs = step(pyramid, lafs)
            note(stage)
    feature.describe(image, lafs)
    note("description")
    return seconds
