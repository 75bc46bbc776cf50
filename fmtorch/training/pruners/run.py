"""A composed config of `fmtorch.train` -> a trained network, its learned files and its card."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.progress import Progress

from fmtorch import __version__, data, presets
from fmtorch.command import console, plain, progress_bars, reporter
from fmtorch.data import ImagePair, PairDataset
from fmtorch.evaluation.run import select
from fmtorch.matched import Augmentation, LabelledMatches, MatchedPairs
from fmtorch.pipeline import Pipeline
from fmtorch.storage.features import cached
from fmtorch.storage.runs import identity_digest
from fmtorch.training.pruners.batches import training_batches
from fmtorch.training.pruners.loop import claim, train
from fmtorch.training.pruners.module import Optimisation, PrunerTraining
from fmtorch.training.pruners.objective import Objective
from fmtorch.training.pruners.pictures import ValidationPictures
from fmtorch.training.pruners.result import write_result
from fmtorch.training.pruners.validation import Use, Validation

PICTURES = 4  # validation pairs that are drawn into the log


@dataclasses.dataclass(frozen=True, eq=False)
class Matches:
    """What a training sees: labelled matches to train on, and to validate on with their pairs."""

    training: MatchedPairs
    validation: list[tuple[ImagePair, LabelledMatches]]
    digest: str


def run(config: DictConfig, name: str) -> Path:
    """Train what a composed config describes and return the folder of the result.

    Started again, it goes on from the last checkpoint; a finished training is only reported.
    name: of the pruner's preset, e.g. ``lc``.
    """
    network_config = network_of(config, name)
    optimisation, objective = Optimisation(**plain(config.optimisation)), Objective(**plain(config.objective))
    uses = {key: use_of(key, value) for key, value in plain(config.validation.uses).items()}
    threads = int(config.threads or os.cpu_count() or 1)
    with progress_bars() as progress:
        matches = labelled_matches(config, progress)
    identity = {
        "network": network_config, "objective": dataclasses.asdict(objective), "batch": config.batch,
        "optimisation": dataclasses.asdict(optimisation), "augmentation": plain(config.augmentation),
        "seed": config.seed, "matches": matches.digest, "version": __version__,
        "validation": {k: v for k, v in plain(config.validation).items() if k in ("every", "monitor", "patience")},
        "trainer": plain(config.trainer),
    }  # fmt: skip
    folder = Path(config.output or f"runs/train/{name}-{identity_digest(identity)[:8]}")
    claim(folder, identity)
    torch.set_num_threads(threads)
    torch.manual_seed(config.seed)
    network = presets.instantiate(network_config, f"pruner={name}, network")
    validation = Validation([m for _, m in matches.validation], uses, [p.family for p, _ in matches.validation])
    module = PrunerTraining(network, objective, optimisation, validation)
    augmentation = Augmentation(**plain(config.augmentation))
    console.print(
        f"{len(matches.training)} pairs to train on, {len(matches.validation)} to validate on; {folder}", highlight=False
    )
    start = time.perf_counter()
    train(
        module,
        lambda step: training_batches(matches.training, augmentation, config.batch, config.seed, step),
        folder,
        plain(config.trainer),
        every=config.validation.every,
        checkpoint_every=config.checkpoint_every,
        patience=config.validation.patience,
        monitor=config.validation.monitor,
        callbacks=(ValidationPictures(matches.validation[:: max(1, len(matches.validation) // PICTURES)][:PICTURES]),),
    )
    write_result(folder, name, module, identity, seconds=time.perf_counter() - start)
    return folder


def network_of(config: DictConfig, name: str) -> dict[str, Any]:
    """The config of the network that a pruner's preset names. Raises ValueError where there is none."""
    pruners = plain(config.pruner)
    chosen = pruners if "_target_" in pruners else next(iter(pruners.values()), {}) if len(pruners) == 1 else {}
    network = chosen.get("network") if isinstance(chosen, Mapping) else None
    if not isinstance(network, Mapping) or "_target_" not in network:
        raise ValueError(
            f"pruner={name} has nothing to train: its preset must have a `network` with a `_target_`, as lc has"
        )
    return {str(key): value for key, value in network.items()}


def use_of(name: str, options: Mapping[str, Any]) -> Use:
    """A way of using P(inlier) from its config: an estimator's preset, and a threshold or null."""
    unknown = set(options) - {"estimator", "threshold"}
    if unknown or "estimator" not in options:
        raise ValueError(f"validation.uses.{name} must have `estimator` and may have `threshold`, not {sorted(unknown)}")
    return Use(presets.build("estimator", str(options["estimator"])), options.get("threshold"))


def labelled_matches(config: DictConfig, progress: Progress) -> Matches:
    """The matches of the config's data set, split by scenes, and of its further validation sets.

    Raises ValueError where a side is empty.
    """
    options = plain(config.dataset)
    if options.get("name") == "rendered":
        options["split"] = "train"
    dataset: PairDataset
    if "_target_" in options:
        dataset = presets.instantiate(options, "dataset")
    else:
        dataset = data.load(**options, progress=reporter(progress, "drawing scenes"))
    front = _front(config)
    training, held_out = split_scenes(dataset, config.validation.scenes, config.limit)
    sets = {"matches to train on": training, "matches to validate on": held_out}
    for root in config.validation.roots:
        sets[f"matches of {root}"] = Subset(data.load("fmbench", root=root))
