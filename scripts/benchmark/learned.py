"""Learned pruners beside all others, on the same matches: before the paper's estimators, and as a prior for our own.

python -m scripts.benchmark learned --root DATA/Strecha --root DATA/KITTI --json FILE.jsonl
python -m scripts.benchmark learned --rendered full --limit 50 --json FILE.jsonl
python -m scripts.benchmark learned --from FILE.jsonl FILE.jsonl --markdown docs/appendix/learned.md
python -m scripts.benchmark learned --ngransac FILE.safetensors ...  # also NG-RANSAC's published weights, as a prior
python -m scripts.benchmark learned --network "seed 1=FILE.safetensors" ...      # also other trainings of `lc`

A pruner's time is the processor's, of its stage alone, on one thread. Every pair is estimated once, with seed 0.
--json is appended to pair by pair: started again, the command goes on where it was interrupted. A row counts only for
the code, options and learned files that it was made with.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import track

from fmtorch import presets
from fmtorch.core.stages import pruned
from fmtorch.data import ImagePair
from fmtorch.evaluation.rows import evaluate
from fmtorch.evaluation.run import select
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from fmtorch.runs.feature_cache import cached
from scripts.benchmark import learned_table
from scripts.benchmark.kept import Kept, Row, Stages, identity, read
from scripts.benchmark.matched import add_set_arguments, options, pruner, sets_of
from scripts.benchmark.sheet import put
from scripts.benchmark.specs import ngransac

console = Console(width=None if sys.stdout.isatty() else 160)
# Pruners in order after one match per location; `ratio` stands in every chain but CODE's, which takes all matches.
HARD = {
    "ratio": "ratio one_to_one",
    "GMS": "ratio one_to_one gms",
    "GMS, scale": "ratio one_to_one gms:with_scale=true",
    "LPM": "ratio one_to_one lpm",
    "CODE": "code one_to_one",
    "frame consistency": "ratio one_to_one frame_consistency likely",
    "LC, F": "ratio one_to_one lc",
    "LC, E": "ratio one_to_one lc_e",
    "LC, F, side information": "ratio one_to_one lc_side",
    "DFE": "ratio one_to_one dfe",
}
PRIOR = {
    "none": "ratio one_to_one",
    "ratio": "ratio one_to_one ratio_prior",
    "GMS": "ratio one_to_one gms:soft=true",
    "LPM": "ratio one_to_one lpm:soft=true",
    "CODE": "code:soft=true one_to_one ratio",
    "frame consistency": "ratio one_to_one frame_consistency",
    "LC, F": "ratio one_to_one lc:soft=true",
    "LC, E": "ratio one_to_one lc_e:soft=true",
    "LC, F, side information": "ratio one_to_one lc_side:soft=true",
    "DFE": "ratio one_to_one dfe:soft=true",
}
USES = {"hard": (HARD, ("ransac_eight_point", "lmeds_eight_point")), "prior": (PRIOR, ("fmtorch",))}
GIVEN = frozenset(("ratio", "one_to_one"))  # what every method has, and what is not counted into its time
KEPT = ("pair", "family", "scene", "ok", "nsgd", "inlier_rate", "inlier_rate_before", "corrs", "corrs_before")


TRAINED = {"lc": "LC, F", "lc_e": "LC, E", "lc_side": "LC, F, side information", "dfe": "DFE"}  # methods, by presets

Chain = list[tuple[str, Any]]  # names of presets, with options, and the stages
Chains = dict[str, dict[str, Chain]]  # use -> method -> its pruners
PLACE = ("pair", "features", "use", "method", "estimator")  # what tells rows apart


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("learned", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_set_arguments(parser)
    parser.add_argument("--features", default="sift", help="features of another kind than the networks saw in training")
    parser.add_argument("--methods", nargs="*", default=list(HARD | PRIOR), choices=list(HARD | PRIOR))
    parser.add_argument("--ngransac", type=Path, help="NG-RANSAC's published weights, converted to safetensors")
    parser.add_argument("--network", action="append", default=[], type=_named, metavar="NAME=[PRESET:]FILE",
                        help=f"weights of another training of a network, {', '.join(TRAINED)}, by default lc; may be "
                        "repeated")  # fmt: skip
    parser.add_argument("--cache", default="off", help="a folder that keeps features from run to run; off: nowhere")
    parser.add_argument("--json", type=Path, help="keep the figures of every pair here, one line each")
    parser.add_argument("--from", nargs="*", type=Path, default=[], dest="earlier", help="add earlier --json")
    parser.add_argument("--markdown", type=Path, help="put the tables between the marks of this file")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    rows = [row for path in arguments.earlier for row in read(path)]
    if arguments.root or arguments.rendered:
        rows += measure(arguments)
    rows = list({tuple(row[name] for name in PLACE): row for row in rows}.values())  # of equals the last
    tables = learned_table.tables(rows)
    for table in tables:
        console.print(table.terminal())
    if arguments.markdown:
        put(arguments.markdown, tables)


def measure(arguments: argparse.Namespace) -> list[Row]:
    """A row for each pair, method, use and estimator, those of an earlier run included."""
    kept = Kept(arguments.json)
    pairs = select([dataset[i] for dataset in sets_of(arguments) for i in range(len(dataset))], arguments.limit)
    extractor = presets.build("features", arguments.features)
    estimators = {name: presets.build("estimator", name) for _, names in USES.values() for name in names}
    front = Pipeline(
        cached(extractor, arguments.cache), presets.build("matcher", "nearest"), {}, next(iter(estimators.values()))
    )
    built = chains(arguments)
    others = {name: TRAINED[preset] for name, preset, _ in arguments.network}
    before: Stages = [("features", arguments.features, {}), ("matcher", "nearest", {})]
    made_with = {
        (use, name, estimator): identity(
            [*before, *_presets(chain), ("estimator", estimator, {})], extractor, *(pruner for _, pruner in chain)
        )
        for use, methods in built.items() for name, chain in methods.items() for estimator in USES[use][1]
    }  # fmt: skip
    known = kept.by(*PLACE, "identity")
    rows: list[Row] = []
    for pair in track(pairs, "pairs", console=console):
        place = {key: (pair.identity, arguments.features, *key, digest) for key, digest in made_with.items()}
        rows += [known[at] for at in place.values() if at in known]
        missing = [key for key, at in place.items() if at not in known]
        if missing:
            todo: Chains = {}
            for use, name, _ in missing:
                todo.setdefault(use, {})[name] = built[use][name]
            new = list(rows_of(front, pair, todo, estimators, arguments.features))
            for row in new:
                row["training_of"] = others.get(row["method"])
                row["identity"] = made_with[row["use"], row["method"], row["estimator"]]
            kept.add(new)
            rows += new
    return rows


def _presets(chain: Chain) -> Stages:
    """The presets of the pruners, with the options that were changed."""
    specs = [spec.partition(":") for spec, _ in chain]
    return [("pruner", name, options(rest)) for name, _, rest in specs]


def chains(arguments: argparse.Namespace) -> Chains:
    """The pruners of each method that is asked for, by use and name."""
    built = {
        use: {name: [(spec, pruner(spec)) for spec in chain.split()] for name, chain in methods.items()
              if name in arguments.methods}
        for use, (methods, _) in USES.items()
    }  # fmt: skip
    before = [(name, pruner(name)) for name in sorted(GIVEN, reverse=True)]
    if arguments.ngransac:
        built["prior"]["NG-RANSAC's network"] = [*before, ("lc", ngransac(arguments.ngransac))]
    for name, network, file in arguments.network:
        for use, word in (("hard", network), ("prior", f"{network}:soft=true")):
            built[use][name] = [*before, (word, presets.build("pruner", network, file=file, soft=use == "prior"))]
    return built


def _named(text: str) -> tuple[str, str, str]:
    """The name, preset and file of another training."""
    name, _, where = text.partition("=")
    preset, _, file = where.partition(":")
    if preset not in TRAINED:
        preset, file = "lc", where
    if not name or not Path(file).is_file():
        raise argparse.ArgumentTypeError(f"{text!r}: NAME=[PRESET:]FILE is wanted, with a file of learned weights")
    return name, preset, file


def rows_of(
    front: Pipeline, pair: ImagePair, built: Chains, estimators: dict[str, Any], features: str
) -> Iterator[Row]:
    """A row for each method and estimator."""
    matched = front.correspondences([pair])[0]
    for use, methods in built.items():
        for name, pruners in methods.items():
            outcome, seconds = timed(matched, pruners, front)
            for estimator in USES[use][1]:
                front.estimator = estimators[estimator]
                row = evaluate(front.estimate([outcome]))[0]
                assert row.seconds_estimation is not None
                values = {field: getattr(row, field) for field in KEPT}
                about = {"use": use, "method": name, "estimator": estimator, "features": features}
                yield {**about, **values, "ms": 1e3 * seconds, "ms_estimator": 1e3 * row.seconds_estimation}


def timed(outcome: Outcome, pruners: Chain, front: Pipeline) -> tuple[Outcome, float]:
    """The outcome after the pruners, and the seconds of those that are not in every chain; front: has the images."""
    c, seconds = outcome.correspondences, 0.0
    if c is None:
        return outcome, seconds
    for name, stage in pruners:
        start = time.process_time()
        c = pruned(stage, c, lambda _: front.images(outcome.pair)).compact()
        seconds += (time.process_time() - start) * (name not in GIVEN)
    return dataclasses.replace(outcome, correspondences=c), seconds
