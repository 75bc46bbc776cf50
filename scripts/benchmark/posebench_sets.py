"""The sets that `benchmark posebench` judges: PoseBench's files, or pairs in FM-Bench's layout; published figures."""

from __future__ import annotations

import argparse
import csv
import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from fmtorch import data
from fmtorch.core.types import Correspondences
from fmtorch.data import DataError, ImagePair
from fmtorch.data.pairs import GivenMatches
from fmtorch.io import h5
from scripts.benchmark import matched
from scripts.benchmark.matched import console

PUBLISHED = Path(__file__).resolve().parent / "posebench.csv"  # PoseLib 2.0.5; results/baseline.2_0_5.json there
THRESHOLDS = (5, 10, 20)  # degrees
Figures = dict[str, dict[str, tuple[float, ...]]]  # method -> data set -> AUC in per cent


class Set(NamedTuple):
    """Pairs with given matches. threshold: px. digest: of the matches."""

    name: str
    threshold: float
    pairs: Sequence[ImagePair]
    digest: str


def read_published() -> tuple[dict[str, float], Figures]:
    """The threshold of each of PoseBench's sets in pixels, and its published figures."""
    thresholds: dict[str, float] = {}
    figures: Figures = {}
    with PUBLISHED.open(encoding="utf-8") as file:
        for line in csv.DictReader(file):
            thresholds[line["dataset"]] = float(line["threshold"])
            values = tuple(float(line[f"auc{t}"]) for t in THRESHOLDS)
            figures.setdefault(line["method"], {})[line["dataset"]] = values
    return thresholds, figures


def sets_of(arguments: argparse.Namespace, thresholds: dict[str, float]) -> Iterator[Set]:
    """The sets that are asked for. Raises SystemExit where there are none, or one has no threshold."""
    if arguments.files is None and not arguments.root and not arguments.rendered:
        raise SystemExit("name FILES, the folder `relative` of PoseBench's data, or --root DATA")
    if arguments.files is not None:
        yield from _files(arguments.files, thresholds, arguments.threshold)
    if arguments.root or arguments.rendered:
        yield from _matched(arguments)


def _files(folder: Path, thresholds: dict[str, float], threshold: float | None) -> Iterator[Set]:
    root = folder / "relative" if (folder / "relative").is_dir() else folder
    try:
        paths = h5.files(root)
    except DataError as error:
        raise SystemExit(f"{error}; give the folder `relative` of PoseBench's data") from error
    given = {path: thresholds.get(path.stem, threshold) for path in paths}
    for path, px in given.items():
        if px is None and not path.stem.startswith("fisheye_"):
            raise SystemExit(f"{path.name} is none of PoseBench's sets: give its threshold in pixels, --threshold PX")
    for path, px in given.items():
        if px is None:
            console.print(f"{path.name}: left out, its cameras are no pinholes", style="dim", highlight=False)
            continue
        try:
            dataset = data.load("h5", root=path, layout="posebench")
        except DataError as error:
            raise SystemExit(str(error)) from error
        yield Set(path.stem, px, [dataset[i] for i in range(len(dataset))], dataset.digest)


def _matched(arguments: argparse.Namespace) -> Iterator[Set]:
    """The matched pairs of known cameras, by their families, with points alone, as PoseBench has them."""
    if arguments.threshold is None:
        raise SystemExit("--root: give the threshold in pixels, --threshold PX")
    families: dict[str, list[ImagePair]] = {}
    for pair, c in matched.load(arguments):
        if all(value is not None for value in (pair.K0, pair.K1, pair.R, pair.t)):
            points = Correspondences(c.x0, c.x1, c.mask, size0=c.size0, size1=c.size1)
            given = dataclasses.replace(pair, matches=functools.partial(_given, points))
            families.setdefault(pair.family, []).append(given)
    digest = matched.identity(arguments)
    yield from (Set(name, arguments.threshold, pairs, digest) for name, pairs in families.items())


def _given(points: Correspondences) -> GivenMatches:
    return GivenMatches(points, (points.mask.shape[1], points.mask.shape[1]))
