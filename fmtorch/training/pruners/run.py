"""A composed config of `fmtorch.train` -> a trained network, its learned files and its card."""

from __future__ import annotations

import dataclasses
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from fmtorch import __version__, presets
from fmtorch.command import console, plain, progress_bars
from fmtorch.storage.runs import identity_digest
from fmtorch.training.pruners.batches import training_batches
from fmtorch.training.pruners.data import labelled_matches
from fmtorch.training.pruners.loop import claim, train
from fmtorch.training.pruners.module import Optimisation, PrunerTraining
from fmtorch.training.pruners.objective import Objective
from fmtorch.training.pruners.pictures import ValidationPictures
from fmtorch.training.pruners.result import Result, write_result
from fmtorch.training.pruners.validation import Use, Validation

PICTURES = 4  # validation pairs that are drawn into the log


def run(config: DictConfig, name: str) -> Path:
    """Train what a composed config describes and return the folder of the result.

    Started again, it goes on from the last checkpoint; a finished training only writes its files anew.
    name: of the pruner's preset, e.g. ``lc``. Raises ValueError for options that cannot be.
    """
    network_config = network_of(config, name)
    optimisation, objective = Optimisation(**plain(config.optimisation)), Objective(**plain(config.objective))
    uses = {key: use_of(key, value) for key, value in plain(config.validation.uses).items()}
    expect_positive(config)
    with progress_bars() as progress:
        matches = labelled_matches(config, progress)
    identity = {
        "network": network_config, "objective": dataclasses.asdict(objective), "batch": config.batch,
        "optimisation": dataclasses.asdict(optimisation), "augmentation": plain(config.augmentation),
        "seed": config.seed, "matches": matches.digest, "version": __version__, "trainer": plain(config.trainer),
        "validation": {k: v for k, v in plain(config.validation).items() if k != "roots"},
    }  # fmt: skip
    folder = Path(config.output or f"runs/train/{name}-{identity_digest(identity)[:8]}")
    claim(folder, identity)
    torch.set_num_threads(int(config.threads or os.cpu_count() or 1))
    torch.manual_seed(config.seed)
    network = presets.instantiate(network_config, f"pruner={name}, network")
    validation = Validation([m for _, m in matches.validation], uses, [p.family for p, _ in matches.validation])
    module = PrunerTraining(network, objective, optimisation, validation)
    first = int(os.environ.get("LOCAL_RANK", "0")) == 0  # of several processes the one that reports
    if first:
        about = f"{len(matches.training)} pairs to train on, {len(matches.validation)} to validate on"
        console.print(f"{about}; {folder}", highlight=False, markup=False)
    shown = matches.validation[:: max(1, len(matches.validation) // PICTURES)][:PICTURES]
    steps, seconds = train(
        module,
        lambda step, rank, processes: training_batches(
            matches.training, config.batch, config.seed, step, rank, processes, workers=config.loaders
        ),
        folder,
        plain(config.trainer),
        every=config.validation.every,
        checkpoint_every=config.checkpoint_every,
        patience=config.validation.patience,
        monitor=config.validation.monitor,
        callbacks=(ValidationPictures(shown),),
    )
    if first:
        processor = f"{os.cpu_count()} cores of {platform.processor() or platform.machine()}"
        facts = {**identity, "steps": steps, "seconds": seconds, "data": matches.description, "processor": processor}
        report(write_result(folder, name, module, facts), name)
    return folder


def report(result: Result, name: str) -> None:
    """Say on the terminal what came out and how to use it."""
    for key, value in result.evaluation.figures.items():
        console.print(f"{key:32} {value:.4f}", highlight=False)
    stages = f"'pruner=[ratio,one_to_one,{name}]' pruner.{name}.file={result.files[0]}"
    use = f"python -m fmtorch.eval pipeline=sift_ratio {stages}"
    for line in (", ".join(str(path) for path in result.files), f"use it: {use}"):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


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
    unknown = sorted(set(options) - {"estimator", "threshold"})
    if unknown or "estimator" not in options:
        raise ValueError(f"validation.uses.{name}: it has `estimator` and may have `threshold`, no {unknown}")
    return Use(presets.build("estimator", str(options["estimator"])), options.get("threshold"))


def expect_positive(config: DictConfig) -> None:
    """Raises ValueError for counts of the config that are not whole numbers of at least one."""
    counts = {
        "batch": config.batch, "checkpoint_every": config.checkpoint_every,
        "validation.every": config.validation.every, "validation.pairs": config.validation.pairs,
        "validation.scenes": config.validation.scenes, "limit": config.limit,
    }  # fmt: skip
    for name, value in counts.items():
        if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
            raise ValueError(f"{name}={value}; it must be a whole number of at least 1")
