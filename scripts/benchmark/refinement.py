"""What `refine_matches` changes: pipelines with and without it on the same matches, pair by pair.

python -m scripts.benchmark refinement --root DATA/Strecha --root DATA/PhotoTourism --cache FOLDER
python -m scripts.benchmark refinement --root DATA/KITTI --rendered small --markdown docs/refinement.md

The stage is put behind the pruners of each pipeline, and each estimator gets both kinds of matches. "distance" is the
median Sampson distance to the true F of the matches within 2 px of it, a mean over pairs; ms are of processor time.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from fmtorch import presets
from fmtorch.core.stages import PairImages, pruned
from fmtorch.data import ImagePair
from fmtorch.evaluation.rows import evaluate
from fmtorch.evaluation.run import select
from fmtorch.evaluation.statistics import MERITS, PERCENT, SHARES, difference
from fmtorch.geometry import sampson
from fmtorch.pipeline.build import load_pipeline
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from scripts.benchmark.matched import add_set_arguments, console, groups, scenes, sets_of
from scripts.benchmark.sheet import Sheet, put, shown

MARKER, STAGE = "refinement", "refine_matches"
PIPELINES = ("sift_fmtorch", "hardnet_fmtorch", "hesaffnet_fmtorch")
NEAR = 2.0  # px from the true epipolar line: matches whose exactness is looked at
BATCH = 16
COLUMNS = ("", "pairs", "before", "after", "%Recall", "R.01", "AUC@0.05", "distance, px", "ms / 500 matches")


class Measured(NamedTuple):
    """Of each pair: NSGD without and with the stage (seeds, n), median distances (n, 2), ms for 500 matches (n,)."""

    before: NDArray[np.float64]
    after: NDArray[np.float64]
    distance: NDArray[np.float64]
    ms: NDArray[np.float64]


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("refinement", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_set_arguments(parser, "pairs of each family at most, chosen by hash")
    parser.add_argument("--pipelines", nargs="*", default=list(PIPELINES), help="presets")
    parser.add_argument("--estimators", nargs="*", default=["fmtorch", "poselib"])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cache", default="null", help="folder of features; null: the user's")
    parser.add_argument("--markdown", type=Path, help=f"put the table between the marks `{MARKER}` of this file")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    pairs = select([dataset[i] for dataset in sets_of(arguments) for i in range(len(dataset))], arguments.limit)
    lines = []
    for name in arguments.pipelines:
        pipeline = load_pipeline(name, overrides=[f"cache={arguments.cache}"])
        kept, before, after, ms = stages(pipeline, pairs, name)
        distance = np.array([[exactness(o) for o in outcomes] for outcomes in (before, after)]).T
        for estimator in arguments.estimators:
            pipeline.estimator = presets.build("estimator", estimator)
            without, refined = (
                np.array([nsgd(pipeline, o, i) for i in range(arguments.seeds)]) for o in (before, after)
            )
            lines += rows(f"`{name}`, {estimator}", kept, Measured(without, refined, distance, ms))
    sheet = Sheet(f"With {STAGE} and without, {arguments.seeds} seeds", COLUMNS, lines)
    console.print(sheet.terminal())
    if arguments.markdown:
        put(arguments.markdown, [sheet], MARKER)


def stages(
    pipeline: Pipeline, pairs: Sequence[ImagePair], name: str
) -> tuple[list[ImagePair], list[Outcome], list[Outcome], NDArray[np.float64]]:
    """The pairs with matches, their outcomes before estimation without and with the stage, and its milliseconds."""
    stage = presets.build("pruner", STAGE)
    before, after, ms = [], [], []
    for pair in track(pairs, name, console=console, transient=True):
        outcome = pipeline.correspondences([pair])[0]
        c = outcome.correspondences
        if c is None or not int(c.count()):
            continue
        images = pipeline.images(pair)
        start = time.process_time()
        refined = pruned(stage, c, functools.partial(_same, images))
        ms.append((time.process_time() - start) * 5e5 / int(c.count()))
        before.append(outcome)
        after.append(dataclasses.replace(outcome, correspondences=refined))
    return [outcome.pair for outcome in before], before, after, np.array(ms)


def _same(images: PairImages, _: int) -> PairImages:
    return images


def exactness(outcome: Outcome) -> float:
    """The median Sampson distance to the true F, px, of the matches within `NEAR` of it; NaN for none."""
    c = outcome.correspondences
    assert c is not None
    r = sampson(torch.from_numpy(outcome.pair.F)[None], c.x0.double(), c.x1.double())[c.mask].abs()
    near = r[r < NEAR]
    return float(near.median()) if len(near) else float("nan")


def nsgd(pipeline: Pipeline, outcomes: Sequence[Outcome], seed: int) -> list[float]:
    """Of each pair, 1 where there is no F."""
    evaluated = []
    for i in range(0, len(outcomes), BATCH):
        evaluated += evaluate(pipeline.estimate(outcomes[i : i + BATCH], seed), seed)
    return [row.nsgd if row.ok else 1.0 for row in evaluated]


def rows(title: str, pairs: list[ImagePair], m: Measured) -> list[list[str]]:
    """A line for each family, and for wide and short baselines."""
    lines = []
    for family, members in groups(pairs).items():
        names = scenes([pair for pair, inside in zip(pairs, members, strict=True) if inside])
        values = [{name: merit(nsgds[:, members]) for name, merit in MERITS.items()} for nsgds in (m.before, m.after)]
        cells = [" / ".join(f"{PERCENT * each.mean():.1f}" for each in value.values()) for value in values]
        for name in MERITS:
            gain = difference(values[1][name], values[0][name], names, PERCENT, share=name in SHARES)
            cells.append(shown(gain, "+.1f"))
        first, second = np.nanmean(m.distance[members], 0)
        cells += [f"{first:.3f} → {second:.3f}", f"{np.median(m.ms[members]):.1f}"]
        lines.append([f"{title}: {family}", str(int(members.sum())), *cells])
    return lines
