"""Pipelines of different features: recall, inlier rates and counts, beside the paper's figures.

python -m scripts.benchmark pipelines --root DATA/Strecha --root DATA/PhotoTourism --json features.jsonl
python -m scripts.benchmark pipelines --rendered full --limit 40 --json features.jsonl
python -m scripts.benchmark pipelines --from features.jsonl --markdown docs/appendix/features.md

--json is appended to batch by batch: started again, the command goes on where it was interrupted. A row counts only
for the learned files and options that it was made with.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from rich.progress import track

from fmtorch import presets
from fmtorch.data import ImagePair
from fmtorch.evaluation.rows import evaluate
from fmtorch.evaluation.run import select
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from fmtorch.presets.pruners import WIDE
from fmtorch.runs import identity_digest
from fmtorch.runs.feature_cache import CachedFeatures
from fmtorch.runs.fingerprint import configuration
from scripts.benchmark import pipelines_table
from scripts.benchmark.kept import Kept, read
from scripts.benchmark.matched import add_set_arguments, console, sets_of
from scripts.benchmark.pruning import pruned_by
from scripts.benchmark.sheet import put
from scripts.benchmark.specs import features_of, pipeline_of

FEATURES = ("sift", "dspsift", "rootsiftpca", "l2net", "geodesc", "hardnet", "hesaffnet")
SYSTEMS = ("rootsiftpca", "hardnet", "hesaffnet")
PIPELINES = [*(f"{name}_ratio" for name in FEATURES), *(f"{name}_gms" for name in SYSTEMS)]
BATCH = 8  # pairs that are kept together
FIGURES = ("nsgd", "inlier_rate", "inlier_rate_before", "corrs", "corrs_before", "ok")


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("pipelines", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_set_arguments(parser, "pairs of each family at most, chosen by hash")
    parser.add_argument(
        "--pipelines", nargs="*", default=PIPELINES, help="PRESET of conf/pipeline, or 'PRESET NAME=VALUE ...'"
    )
    parser.add_argument("--overrides", nargs="*", default=[], help="of each pipeline, e.g. features.precision=int8")
    parser.add_argument("--label", default="", help="appended to the pipelines' names in the tables")
    add_measure_arguments(parser, seeds=5)
    parser.set_defaults(run=run)


def add_measure_arguments(parser: argparse.ArgumentParser, seeds: int) -> None:
    """The options of `measure` and of what is done with its rows."""
    parser.add_argument("--seeds", type=int, default=seeds, help="of the estimators; recall is their mean")
    parser.add_argument("--cache", default="null", help="folder of features; null: the user's")
    parser.add_argument("--json", type=Path, help="keep the figures of every pair here, one line each")
    parser.add_argument("--from", nargs="*", type=Path, default=[], dest="earlier", help="only show earlier --json")
    parser.add_argument("--markdown", type=Path, help="put the tables between the marks of this file")


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    rows = [row for path in arguments.earlier for row in read(path)]
    if arguments.root or arguments.rendered:
        rows += measure(arguments)
    rows = list({(row["pair"], row["method"]): row for row in rows}.values())  # the last of equals
    tables = pipelines_table.tables(rows)
    for table in tables:
        console.print(table.terminal())
    if arguments.markdown:
        put(arguments.markdown, tables)


def measure(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for each pipeline and pair, those of an earlier run included."""
    every = [dataset[i] for dataset in sets_of(arguments) for i in range(len(dataset))]
    pairs = select(every, arguments.limit)
    kept = Kept(arguments.json)
    known = list(kept.rows)
    rows = []
    for wide in (True, False):
        same_width = [pair for pair in pairs if (pair.family in WIDE) == wide]
        for group in by_features(arguments) if same_width else []:
            pipelines = {name: pipeline for name, (pipeline, _) in group.items()}
            identity = {name: digest for name, (_, digest) in group.items()}
            own = [row for row in known if identity.get(row["method"]) == row["identity"]]
            rows += own
            done = set.intersection(*({row["pair"] for row in own if row["method"] == name} for name in group))
            todo = [pair for pair in same_width if pair.identity not in done]
            batches = [todo[i : i + BATCH] for i in range(0, len(todo), BATCH)]
            for batch in track(batches, next(iter(pipelines)), console=console):
                new = list(rows_of(pipelines, batch, arguments.seeds, identity))
                rows += new
                kept.add(new)
    return rows


def by_features(arguments: argparse.Namespace) -> Iterator[dict[str, tuple[Pipeline, str]]]:
    """The pipelines in groups that share features and matches, by the names that the tables show.

    With each the digest of its options and learned files.
    """
    groups: dict[str, dict[str, tuple[Pipeline, str]]] = {}
    for name in arguments.pipelines:
        preset, *own = name.split()
        overrides = [*own, *arguments.overrides]
        pipeline = pipeline_of(preset, f"cache={arguments.cache}", *overrides)
        extractor = pipeline.extractor
        features = extractor.extractor if isinstance(extractor, CachedFeatures) else extractor
        made_with = {"features": configuration(features), "stages": presets.pipeline_stages(preset),
                     "overrides": overrides, "seeds": arguments.seeds}  # fmt: skip
        label = name + arguments.label
        groups.setdefault(features_of(name), {})[label] = pipeline, identity_digest(made_with)[:16]
    yield from groups.values()


def rows_of(
    pipelines: dict[str, Pipeline], batch: Sequence[ImagePair], seeds: int, identity: dict[str, str]
) -> Iterator[dict[str, Any]]:
    """A row for each pipeline and pair, with a list over seeds for each figure.

    All have the pruners of the shortest of them, whose matches are shared.
    """
    front = min(pipelines.values(), key=lambda p: len(p.pruners))
    matched = front.match(batch)
    for name, pipeline in pipelines.items():
        outcomes: list[Outcome] = []
        for outcome in matched:
            stages = pipeline.pruners_of(outcome.pair.family)
            own = [stage for key, stage in stages.items() if key not in front.pruners]
            outcomes.append(pruned_by(outcome, own, pipeline))
        runs = [evaluate(pipeline.estimate(outcomes, seed), seed) for seed in range(seeds)]
        for same in zip(*runs, strict=True):
            row = {field: getattr(same[0], field) for field in ("pair", "family", "scene", "features0", "features1")}
            figures = {field: [getattr(r, field) for r in same] for field in FIGURES}
            yield {"method": name, "identity": identity[name], **row, **figures}
