"""The matched pairs that benchmarks of pruners and estimators start from."""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from fmtorch import data, presets
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import ImagePair, PairDataset
from fmtorch.evaluation.statistics import scene_names
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.presets.pruners import WIDE
from fmtorch.runs.feature_cache import cached
from scripts.benchmark import kept

console = Console(width=None if sys.stdout.isatty() else 170)

Item = tuple[ImagePair, Correspondences]


def add_set_arguments(parser: argparse.ArgumentParser, limit: str = "pairs of each family at most") -> None:
    """The options that say which pairs; `limit` is the help of the last one."""
    parser.add_argument("--root", action="append", default=[], help="a set in the FM-Bench layout; may be repeated")
    parser.add_argument("--rendered", choices=["small", "full"], help="also the embedded data set, of this size")
    parser.add_argument("--split", default="test", help="of --rendered: test or train; a --root has no splits")
    parser.add_argument("--limit", type=int, help=limit)


def sets_of(arguments: argparse.Namespace) -> list[PairDataset]:
    """The data sets that these options name, before any limit."""
    sets = [data.load("fmbench", root=root) for root in arguments.root]
    if arguments.rendered:
        sets.append(data.load("rendered", arguments.split, size=arguments.rendered))
    return sets


def options(text: str) -> dict[str, Any]:
    """``KEY=VALUE,...``: numbers, true, false or null as in JSON; anything else is text.

    ``PART.KEY=VALUE`` is the option KEY of a part, as on the command line.
    """
    changed: dict[str, Any] = {}
    for key, value in (item.split("=") for item in text.split(",") if item):
        *parts, last = key.split(".")
        inside = changed
        for part in parts:
            inside = inside.setdefault(part, {})
        inside[last] = parsed(value)
    return changed


def split(word: str) -> tuple[str, dict[str, Any]]:
    """The preset of `PRESET[:KEY=VALUE,...]` and its changed options."""
    name, _, rest = word.partition(":")
    return name, options(rest)


def pruner(word: str) -> Any:
    """The stage of `PRUNER[:KEY=VALUE,...]`."""
    name, changed = split(word)
    return presets.build("pruner", name, **changed)


def parsed(value: str) -> Any:
    """A number, true, false or null; anything else is text."""
    try:
        return json.loads(value)
    except json.JSONDecodeError:
        return value


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `load`."""
    add_set_arguments(parser, "pairs of each set at most")
    parser.add_argument("--features", default="sift")
    parser.add_argument("--pruners", nargs="*", default=["ratio", "one_to_one"])
    parser.add_argument("--cache", default="off", help="a folder that keeps features from run to run; off: nowhere")


def identity(arguments: argparse.Namespace) -> str:
    """The digest of what the matches of `load` depend on, but for the images."""
    stages: kept.Stages = [("features", arguments.features, {}), ("matcher", "nearest", {})]
    stages += [("pruner", *split(word)) for word in arguments.pruners]
    return kept.identity(stages, *(presets.build(group, name, **changed) for group, name, changed in stages))


def load(arguments: argparse.Namespace) -> list[Item]:
    """Every usable pair of the sets that are asked for, with its matches as a batch of one."""
    pairs: list[ImagePair] = []
    for dataset in sets_of(arguments):
        ordered = sorted((dataset[i] for i in range(len(dataset))), key=lambda pair: pair.key)
        pairs += ordered[: arguments.limit]
    pairs.sort(key=lambda pair: pair.identity)
    pruners: dict[str, Any] = {word: pruner(word) for word in arguments.pruners}
    front = Pipeline(
        cached(presets.build("features", arguments.features), arguments.cache),
        presets.build("matcher", "nearest"), pruners, _no_estimator,
    )  # fmt: skip
    with ThreadPoolExecutor(torch.get_num_threads()) as workers:
        matched = workers.map(lambda pair: front.match([pair])[0], pairs)
        outcomes = list(track(matched, "matching", total=len(pairs), console=console))
    items = [(o.pair, o.correspondences) for o in outcomes if o.correspondences is not None]
    typical = np.median([int(c.count()) for _, c in items])
    console.print(f"{len(items)} of {len(pairs)} pairs, median {typical:.0f} matches")
    return items


def _no_estimator(c: Correspondences, seed: int = 0) -> Estimate:
    raise NotImplementedError("matches alone are asked for")


def groups(pairs: list[ImagePair]) -> dict[str, NDArray[np.bool_]]:
    """Which pairs (n,) belong to each family, to the wide and to the short baselines, and to all."""
    masks = {family: np.array([p.family == family for p in pairs]) for family in sorted({p.family for p in pairs})}
    wide = np.array([p.family in WIDE for p in pairs])
    if len(masks) > 1:
        if wide.any() and not wide.all():
            masks |= {"wide baselines": wide, "short baselines": ~wide}
        masks["all"] = np.ones(len(pairs), bool)
    return masks


def scenes(pairs: list[ImagePair]) -> list[str]:
    """The scene of each pair, with its family."""
    return scene_names([pair.family for pair in pairs], [pair.scene for pair in pairs])
