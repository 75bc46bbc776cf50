"""Robust estimators on the same matches, one thread each: recall, mean recall, milliseconds, paired intervals.

python scripts/benchmark estimators --root DATA/Strecha --root DATA/PhotoTourism \
    --estimators ransac lmeds opencv_ransac opencv_usac_magsac:threshold=0.5 poselib --seeds 5
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table

from fmtorch import data, metrics, presets
from fmtorch.data import ImagePair
from fmtorch.pipeline import Pipeline
from fmtorch.types import Correspondences

console = Console(width=None if sys.stdout.isatty() else 160)


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("estimators", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_matches_arguments(parser)
    parser.add_argument(
        "--estimators", nargs="+", required=True, help="presets, with options as name:key=value,key=value"
    )
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--baseline", type=Path, help="a file written by --json, to compare recall and time with")
    parser.set_defaults(run=run)


def add_matches_arguments(parser: argparse.ArgumentParser) -> None:
    """The options that say which image pairs are matched, and how."""
    parser.add_argument("--root", action="append", default=[], help="a set in the FM-Bench layout; may be repeated")
    parser.add_argument("--rendered", choices=["small", "full"], help="also the embedded data set, of this size")
    parser.add_argument("--split", default="test")
    parser.add_argument("--limit", type=int, help="pairs of each set at most")
    parser.add_argument("--pruners", nargs="*", default=["ratio", "one_to_one"])


def matched_pairs(arguments: argparse.Namespace) -> list[Any]:
    """The image pairs that the options name, with their matches."""
    pairs: list[ImagePair] = []
    sets = [data.load("fmbench", arguments.split, root) for root in arguments.root]
    if arguments.rendered:
        sets.append(data.load("rendered", arguments.split, size=arguments.rendered))
    for dataset in sets:
        whole = sorted((dataset[i] for i in range(len(dataset))), key=lambda pair: pair.key)
        pairs += whole[: arguments.limit]
    pruners = {name: presets.build("pruner", name) for name in arguments.pruners}
    front = Pipeline(
        presets.build("features", "sift"), presets.build("matcher", "nearest"), pruners, lambda c, seed=0: None
    )
    pairs.sort(key=lambda pair: pair.identity)
    matched = [front.match([pair])[0] for pair in track(pairs, "matching", console=console)]
    usable = [m for m in matched if m.correspondences is not None]
    typical = np.median([int(m.correspondences.count()) for m in usable])
    console.print(f"{len(usable)} of {len(pairs)} pairs, median {typical:.0f} matches")
    return usable


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    usable = matched_pairs(arguments)
    results = {}
    for spec in arguments.estimators:
        results[spec] = measure(spec, [(m.pair, m.correspondences) for m in usable], arguments.seeds)
    report(results, [m.pair for m in usable])
    figures = {spec: summary(result) for spec, result in results.items()}
    if arguments.baseline:
        compare(figures, json.loads(arguments.baseline.read_text())["figures"])
    if arguments.json:
        machine = {"processor": platform.processor() or platform.machine(), "torch": torch.__version__}
        arguments.json.write_text(
            json.dumps({"machine": machine, "pairs": len(usable), "figures": figures}, indent=1) + "\n"
        )


def build(spec: str) -> Any:
    """An estimator from `name` or `name:key=value,key=value`."""
    name, _, rest = spec.partition(":")
    options = {key: json.loads(value) for key, value in (item.split("=") for item in rest.split(",") if item)}
    return presets.build("estimator", name, **options)


def measure(spec: str, items: list[tuple[ImagePair, Correspondences]], seeds: int) -> dict[str, np.ndarray]:
    """NSGD (seeds, pairs) and milliseconds (seeds, pairs) of one estimator, one pair a call."""
    estimator = build(spec)
    estimator(items[0][1], 0)  # not counted: lazy initialisation
    nsgd, milliseconds = np.ones((seeds, len(items))), np.zeros((seeds, len(items)))
    for seed in range(seeds):
        for i, (pair, c) in enumerate(track(items, f"{spec}, seed {seed}", console=console, transient=True)):
            start = time.perf_counter()
            estimate = estimator(c, seed)
            milliseconds[seed, i] = 1e3 * (time.perf_counter() - start)
            if bool(estimate.ok[0]):
                F = torch.from_numpy(pair.F)[None]
                nsgd[seed, i] = float(metrics.nsgd(F, estimate.F, c.size0, c.size1, key=c.keys))
    return {"nsgd": nsgd, "ms": milliseconds}


def summary(result: dict[str, np.ndarray]) -> dict[str, float]:
    nsgd, ms = result["nsgd"], result["ms"]
    return {
        "recall_05": 100 * float((nsgd < 0.05).mean()),
        "recall_01": 100 * float((nsgd < 0.01).mean()),
        "mean_recall": 100 * float(np.clip(1 - nsgd / 0.05, 0, 1).mean()),
        "ms_median": float(np.median(ms)),
        "ms_mean": float(ms.mean()),
    }


def report(results: dict[str, dict[str, np.ndarray]], pairs: list[ImagePair]) -> None:
    """A table per scene group, with the difference to the first estimator and its 95 % interval."""
    families = sorted({pair.family for pair in pairs})
    groups = {"all": np.ones(len(pairs), bool)} if len(families) == 1 else {}
    groups |= {family: np.array([pair.family == family for pair in pairs]) for family in families}
    groups["all"] = np.ones(len(pairs), bool)
    first = next(iter(results.values()))
    for group, inside in groups.items():
        table = Table(title=f"{group}: {int(inside.sum())} pairs, {len(first['nsgd'])} seeds")
        for column in (
            "estimator",
            "R.05",
            "R.01",
            "mAA",
            "first minus this: R.01",
            "mAA",
            "ms median",
            "ms mean",
            "ratio",
        ):
            table.add_column(column, justify="left" if column == "estimator" else "right")
        clusters = np.array([pair.scene for pair in pairs])[inside]
        for spec, result in results.items():
            own = {key: value[:, inside] for key, value in result.items()}
            base = {key: value[:, inside] for key, value in first.items()}
            s = summary(own)
            differences = [
                paired_interval(score(base["nsgd"]) - score(own["nsgd"]), clusters)
                for score in (lambda v: 1.0 * (v < 0.01), lambda v: np.clip(1 - v / 0.05, 0, 1))
            ]
            shown = ["" if result is first else f"{m:+.1f} [{low:+.1f}, {high:+.1f}]" for m, low, high in differences]
            ratio = float(np.median(own["ms"].mean(0) / base["ms"].mean(0)))
            table.add_row(
                spec, f"{s['recall_05']:.1f}", f"{s['recall_01']:.1f}", f"{s['mean_recall']:.1f}", *shown,
                f"{s['ms_median']:.2f}", f"{s['ms_mean']:.2f}", f"{ratio:.2f}",
            )  # fmt: skip
        console.print(table)


def paired_interval(difference: np.ndarray, clusters: np.ndarray, resamples: int = 2000) -> tuple[float, float, float]:
    """Mean of (seeds, pairs) differences in percent and its 95 % bootstrap interval.

    Scenes are resampled, and pairs within each; with a single scene only pairs.
    """
    rng = np.random.default_rng(0)
    per_pair = difference.mean(0)
    members = [np.flatnonzero(clusters == cluster) for cluster in np.unique(clusters)]
    means = np.empty(resamples)
    for b in range(resamples):
        scenes = rng.integers(len(members), size=len(members)) if len(members) > 1 else [0]
        index = np.concatenate([rng.choice(members[s], len(members[s])) for s in scenes])
        means[b] = per_pair[index].mean()
    low, high = np.percentile(means, [2.5, 97.5])
    return 100 * float(per_pair.mean()), 100 * float(low), 100 * float(high)


def compare(figures: dict[str, dict[str, float]], before: dict[str, dict[str, float]]) -> None:
    """How recall and time differ from an earlier run's."""
    for spec in figures.keys() & before.keys():
        now, then = figures[spec], before[spec]
        changes = ", ".join(f"{key} {now[key] - then[key]:+.2f}" for key in now)
        console.print(f"{spec} against the baseline: {changes}")
