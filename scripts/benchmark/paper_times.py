"""The runtime table of the paper's supplement: ours on this processor, one thread, beside its figures.

python -m scripts.benchmark paper_times --root DATA/KITTI --limit 20 --markdown docs/appendix/paper.md

Features: of one image, detection included. Pruners and estimators: of the matches of one pair (VLFeat's SIFT, ratio
test at 0.8), one pair a call. Methods of a stage take turns; the medians of processor time are shown.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from rich.progress import track

from fmtorch import presets
from fmtorch.core.types import Correspondences
from fmtorch.data import ImagePair, read_image
from fmtorch.evaluation.run import select
from fmtorch.pipeline.build import load_pipeline
from scripts.benchmark.matched import add_set_arguments, console, sets_of
from scripts.benchmark.sheet import MISSING, Sheet, put

PAPER = Path(__file__).resolve().parent / "paper_times.csv"  # Bian et al., BMVC 2019, supplement
MARKER = "times"
STAGES = {"features": "features of an image", "pruner": "pruner", "estimator": "estimator"}


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("paper_times", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_set_arguments(parser, "pairs of each family at most, chosen by hash")
    parser.add_argument("--markdown", type=Path, help="put the table between the marks `times` of this file")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    pairs = select([dataset[i] for dataset in sets_of(arguments) for i in range(len(dataset))], arguments.limit)
    front = load_pipeline("paper/sift_ratio", overrides=["features=sift_vlfeat"])
    matches = [o.correspondences for o in front.correspondences(pairs) if o.correspondences is not None]
    with PAPER.open(encoding="utf-8") as file:
        published = list(csv.DictReader(file))
    lines = []
    for stage, title in STAGES.items():
        rows = [row for row in published if row["stage"] == stage]
        objects = {row["preset"]: presets.build(stage, row["preset"]) for row in rows}
        items: Sequence[object] = [read_image(pair.image0) for pair in pairs] if stage == "features" else matches
        times = measured(objects, items)
        for row in rows:
            theirs = f"{float(row['seconds']):.3f} ({row['machine']})" if row["seconds"] else MISSING
            ours = np.median(times[row["preset"]])
            lines.append([f"{title}: {row['method']}", f"`{row['preset']}`", f"{ours:.4f}", theirs])
    title = f"Seconds, {described(pairs, matches)}"
    sheet = Sheet(title, ["", "preset", "here, one thread", "the paper"], lines)
    console.print(sheet.terminal())
    if arguments.markdown:
        put(arguments.markdown, [sheet], MARKER)


def measured(objects: dict[str, Callable[[Any], Any]], items: Sequence[object]) -> dict[str, list[float]]:
    """Seconds of processor time of each object on each item; a first call is not counted."""
    times: dict[str, list[float]] = {name: [] for name in objects}
    for call in objects.values():
        call(items[0])
    for item in track(items, "measuring", console=console, transient=True):
        for name, call in objects.items():
            start = time.process_time()
            call(item)
            times[name].append(time.process_time() - start)
    return times


def described(pairs: Sequence[ImagePair], matches: Sequence[Correspondences]) -> str:
    """How many pairs there are, of which families, and their median number of matches."""
    families = ", ".join(sorted({pair.family for pair in pairs}))
    return f"{len(pairs)} pairs of {families}, median {np.median([int(c.count()) for c in matches]):.0f} matches"
