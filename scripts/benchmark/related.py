"""The verdict on pairs of one scene and of different scenes: shares accepted and rejected, and ROC.

python -m scripts.benchmark related --root DATA/Strecha --root DATA/PhotoTourism --root DATA/KITTI --root DATA/TUM \
    --folder related/test --update docs/appendix/related.md
python -m scripts.benchmark related --folder related/test --update docs/appendix/related.md \
    --figure docs/appendix/related.svg

The second line shows what the folder holds. It keeps features, matches and rows: started again, the command goes on
where it was interrupted. Take another folder for other code or other options.
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import torch
from rich.progress import track

from fmtorch import metrics
from fmtorch.core.files import replacing
from fmtorch.core.stages import pruned
from fmtorch.core.types import Correspondences, collate
from fmtorch.data import ImagePair
from fmtorch.pipeline.build import load_pipeline
from fmtorch.pipeline.pipeline import Pipeline
from scripts.benchmark import related_figure, related_table
from scripts.benchmark.estimators_table import replaced
from scripts.benchmark.matched import add_set_arguments, console, sets_of
from scripts.benchmark.related_pairs import UNRELATED, in_order, unrelated_pairs
from scripts.benchmark.specs import features_of, pipeline_of

PIPELINES = [
    "sift_fmtorch", "sift_gms", "sift_ratio estimator=lmeds_eight_point", "hardnet_fmtorch", "hesaffnet_fmtorch",
    "hesaffnet_gms",
]  # fmt: skip
SHARED = ("ratio", "one_to_one")  # pruners that come first in all of them: matches are kept behind these
BATCH = 32  # pairs that are kept together
FIELDS = ("x0", "x1", "mask", "quality", "lafs0", "lafs1", "size0", "size1", "key")


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("related", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_set_arguments(parser, "related pairs of each family at most, chosen by hash; others are of their photographs")
    parser.add_argument(
        "--pipelines", nargs="*", default=PIPELINES, help="PRESET of conf/pipeline, or 'PRESET NAME=VALUE ...'"
    )
    parser.add_argument("--unrelated", type=int, default=300, help="pairs of each two scenes at most, chosen by hash")
    parser.add_argument("--folder", type=Path, default=Path("related"), help="keeps features, matches and rows")
    parser.add_argument("--update", type=Path, help="put the tables between the marks of this file")
    parser.add_argument("--figure", type=Path, help="draw the ROC curves here, as SVG")
    parser.add_argument("--marker", default="related", help="which marks: <!-- MARKER --> and <!-- end MARKER -->")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    if arguments.root or arguments.rendered:
        pairs = chosen_pairs(arguments)
        unrelated = sum(pair.family.startswith(UNRELATED) for pair in pairs)
        console.print(f"{len(pairs) - unrelated} related pairs, {unrelated} unrelated ones")
        for feature in dict.fromkeys(map(features_of, arguments.pipelines)):
            names = [name for name in arguments.pipelines if features_of(name) == feature]
            for name, batch, c in matches(feature, pairs, arguments.folder):
                for pipeline in names:
                    judge(pipeline, name, batch, c, arguments.folder)
    rows = read(arguments.folder, arguments.pipelines)
    text = related_table.text(rows)
    console.print(text, markup=False)
    if arguments.update and not replaced(arguments.update, arguments.marker, text):
        raise SystemExit(f"{arguments.update} has no lines <!-- {arguments.marker} --> and <!-- end ... -->")
    if arguments.figure:
        related_figure.draw(rows, arguments.figure)


def chosen_pairs(arguments: argparse.Namespace) -> list[ImagePair]:
    """The related pairs of the data sets, and unrelated ones across their scenes."""
    datasets = sets_of(arguments)
    related: dict[str, list[ImagePair]] = {}
    for pair in sorted((d[i] for d in datasets for i in range(len(d))), key=lambda pair: pair.key):
        if pair.problem is None:
            related.setdefault(pair.family, []).append(pair)
    chosen = [pair for family in related.values() for pair in family[: arguments.limit]]
    return in_order([*chosen, *unrelated_pairs(chosen, datasets, arguments.unrelated)])


def batches(pairs: Sequence[ImagePair]) -> Iterator[tuple[str, list[ImagePair]]]:
    """The pairs in batches, each with a name that tells which pairs these are."""
    for start in range(0, len(pairs), BATCH):
        batch = list(pairs[start : start + BATCH])
        yield hashlib.blake2b("\n".join(p.identity for p in batch).encode(), digest_size=8).hexdigest(), batch


def matches(
    feature: str, pairs: Sequence[ImagePair], folder: Path
) -> Iterator[tuple[str, list[ImagePair], Correspondences]]:
    """Each batch of pairs with its name and its matches after `SHARED`, computed where the folder does not have them.

    A pair whose images have no features has an empty mask.
    """
    front: Pipeline = load_pipeline(f"{feature}_ratio", overrides=[f"cache={folder / 'features'}"])
    assert tuple(front.pruners) == SHARED
    kept = folder / "matches" / feature
    kept.mkdir(parents=True, exist_ok=True)
    for name, batch in track(list(batches(pairs)), feature, console=console):
        path = kept / f"{name}.pt"
        if not path.exists():
            matched = [outcome.correspondences or _nothing(outcome.pair) for outcome in front.correspondences(batch)]
            fields = {name: getattr(collate([_slim(c) for c in matched]), name) for name in FIELDS}
            with replacing(path) as temporary:
                torch.save(fields, temporary)
        yield name, batch, Correspondences(**torch.load(path))


def _slim(c: Correspondences) -> Correspondences:
    return Correspondences(**{name: getattr(c, name) for name in FIELDS}).compact()


def _nothing(pair: ImagePair) -> Correspondences:
    points, frames = torch.zeros(1, 0, 2), torch.zeros(1, 0, 2, 3)
    size = torch.ones(1, 2, dtype=torch.int64)
    return Correspondences(
        points, points, torch.zeros(1, 0, dtype=torch.bool), quality=points[..., 0], lafs0=frames, lafs1=frames,
        size0=size, size1=size, key=torch.tensor([pair.key]),
    )  # fmt: skip


def judge(name: str, batch: str, pairs: Sequence[ImagePair], c: Correspondences, folder: Path) -> None:
    """Write a row for each pair of a batch, unless it is there: what a pipeline makes of it from its matches on."""
    path = folder / "rows" / name / f"{batch}.parquet"
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    pipeline = pipeline_of(name)
    for pruner in [stage for key, stage in pipeline.pruners.items() if key not in SHARED]:
        c = pruned(pruner, c, lambda i: pipeline.images(pairs[i])).compact()
    estimate = pipeline.estimator(c, 0).detach()
    significance = estimate.significance
    assert significance is not None
    assert c.size0 is not None
    assert c.size1 is not None
    F = torch.stack([torch.from_numpy(pair.F) for pair in pairs])
    true = F.flatten(1).any(1)
    error = torch.where(true & estimate.ok, metrics.nsgd(F, estimate.F, c.size0, c.size1, key=c.keys), 1.0)
    columns = {
        "pair": [pair.identity for pair in pairs], "family": [pair.family for pair in pairs],
        "scene": [pair.scene for pair in pairs], "true": true.tolist(), "ok": estimate.ok.tolist(),
        "nsgd": error.tolist(), "significance": significance.tolist(),
        "inliers": estimate.inliers.sum(1).tolist(), "matches": c.count().tolist(),
    }  # fmt: skip
    with replacing(path) as temporary:
        pq.write_table(pa.table(columns), temporary)


def read(folder: Path, pipelines: Sequence[str]) -> dict[str, list[related_table.Row]]:
    """The rows of each pipeline that has some, one a pair."""
    rows: dict[str, list[related_table.Row]] = {}
    for name in pipelines:
        for path in sorted((folder / "rows" / name).glob("*.parquet")):
            rows.setdefault(name, []).extend(pq.read_table(path).to_pylist())
    return {name: list({row["pair"]: row for row in own}.values()) for name, own in rows.items()}
