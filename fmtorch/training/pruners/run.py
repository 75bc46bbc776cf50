"""A composed config of `fmtorch.train` -> a trained network, its learned files and its card."""

from __future__ import annotations

import dataclasses
import itertools
import os
import platform
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from lightning import Trainer
from omegaconf import DictConfig
from torch.utils.data import DataLoader, Sampler

from fmtorch import presets
from fmtorch.core.options import Within, expect_options
from fmtorch.core.settings import claim
from fmtorch.core.terminal import console, progress_bars
from fmtorch.core.version import __version__
from fmtorch.pipeline.labelled import (
    Augmentation,
    Draw,
    LabelledMatches,
    SimilarLengthBatches,
    StoredMatches,
    collate_trimmed,
)
from fmtorch.presets import plain
from fmtorch.presets.fields import Cache, Count, Gigabytes, Seed, read_fields
from fmtorch.runs.run_folder import identity_digest
from fmtorch.training.planes import PlaneViews
from fmtorch.training.pruners.data import labelled_matches
from fmtorch.training.pruners.loop import train
from fmtorch.training.pruners.module import Optimisation, PrunerTraining
from fmtorch.training.pruners.objective import Objective
from fmtorch.training.pruners.pictures import ValidationPictures
from fmtorch.training.pruners.result import Result, write_result
from fmtorch.training.pruners.validation import Use, Validation

PICTURES = 4  # validation pairs that are drawn into the log


@dataclasses.dataclass(frozen=True)
class ValidationFields:
    """What ``validation`` of the command's config holds; ``conf/train.yaml`` says what each is."""

    every: Count = 250
    scenes: Count = 4
    roots: list[str] = dataclasses.field(default_factory=list)
    pairs: Count = 25
    ratio: float = 0.8
    uses: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    monitor: str = "log_loss"
    patience: Count | None = None


@dataclasses.dataclass(frozen=True)
class Fields:
    """What the command takes at the top level, beside what it chooses; ``conf/train.yaml`` says what each is."""

    before: list[str] = dataclasses.field(default_factory=list)
    limit: Count | None = None
    seed: Seed = 0
    output: Path | None = None
    cache: Cache = None
    cache_limit: Gigabytes | None = 20
    workers: Count | None = None
    loaders: Annotated[int, Within(0)] = 0
    threads: Count | None = None
    batch: Count = 32
    checkpoint_every: Count = 100


@dataclasses.dataclass(frozen=True)
class PlanesFields:
    """What ``planes`` of the command's config holds beside the options of `PlaneViews`."""

    photographs: Path | None = None
    seed: Seed = 0


PARTS = {"optimisation": Optimisation, "objective": Objective, "augmentation": Augmentation, "trainer": Trainer}


def run(config: DictConfig, name: str) -> Path:
    """Train what a composed config describes and return the folder of the result.

    Started again, it goes on from the last checkpoint; a finished training only writes its files anew.
    name: of the pruner's preset, e.g. ``lc``. Raises ValueError for options that cannot be.
    """
    read_fields(Fields, config)
    read_fields(ValidationFields, config.validation, "validation")
    read_fields(PlanesFields, config.planes, "planes")
    own = {field.name for field in dataclasses.fields(PlanesFields)}
    expect_options(PlaneViews, {k: v for k, v in plain(config.planes).items() if k not in own}, "planes")
    for group, part in PARTS.items():
        expect_options(part, plain(config[group]), group)
    presets.expect_buildable(presets.plain(config.dataset), "dataset")
    presets.expect_stages(config)
    network_config = network_of(config, name)
    optimisation, objective = Optimisation(**plain(config.optimisation)), Objective(**plain(config.objective))
    uses = {key: use_of(key, value) for key, value in plain(config.validation.uses).items()}
    with progress_bars() as progress:
        matches = labelled_matches(config, progress)
    identity = {
        "network": network_config, "objective": dataclasses.asdict(objective), "batch": config.batch,
        "optimisation": dataclasses.asdict(optimisation), "augmentation": plain(config.augmentation),
        "seed": config.seed, "matches": matches.digest, "version": __version__, "trainer": plain(config.trainer),
        "validation": {k: v for k, v in plain(config.validation).items() if k != "roots"},
    }  # fmt: skip
    folder = Path(config.output or f"runs/train/{name}-{identity_digest(identity)[:8]}")
    claim(folder / "training.json", identity, "checkpoints", "choose another output")
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
    use = use_line(name, result.files[0], sys.argv[1:])
    for line in (", ".join(str(path) for path in result.files), f"use it: {use}"):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def use_line(name: str, file: Path, words: Sequence[str]) -> str:
    """The command that uses a learned file as a prior, by which it serves best. words: of the training's command."""
    folders = [shlex.quote(b) for a, b in itertools.pairwise(words) if a in ("--config-dir", "-cd")]
    folders += [shlex.quote(word.partition("=")[2]) for word in words if word.startswith("--config-dir=")]
    stages = f"'pruner=[ratio,one_to_one,{name}]' pruner.{name}.file={shlex.quote(str(file))}"
    start = " ".join(["python -m fmtorch.eval", *(f"--config-dir {folder}" for folder in folders)])
    return f"{start} pipeline=sift_ratio estimator=fmtorch {stages} pruner.{name}.threshold=null"


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


class EndlessBatches(Sampler[list[Draw]]):
    """Epoch after epoch of `batches`, from the batch of a given step on."""

    def __init__(self, batches: SimilarLengthBatches, step: int) -> None:
        self.batches, self.step = batches, step

    def __iter__(self) -> Iterator[list[Draw]]:
        self.batches.set_epoch(0)
        epoch, start = divmod(self.step, len(self.batches))
        while True:
            self.batches.set_epoch(epoch, start)
            yield from self.batches
            epoch, start = epoch + 1, 0


def training_batches(
    matches: StoredMatches, batch: int, seed: int, step: int, rank: int = 0, processes: int = 1, *, workers: int = 0
) -> DataLoader[LabelledMatches]:
    """A loader of augmented batches from `step` on, which never ends.

    Args:
        matches: with the augmentation of the training.
        batch: pairs in a batch of one process. seed: selects batches and augmentation. step: steps done so far.
        rank, processes: of a distributed training. workers: processes that load; 0: this one.
    """
    lengths = None if matches.augmentation is None else matches.augmentation.matches
    similar = SimilarLengthBatches(matches, batch, seed=seed, matches=lengths, rank=rank, world_size=processes)
    return DataLoader(
        matches, batch_sampler=EndlessBatches(similar, step), collate_fn=collate_trimmed, num_workers=workers,
        persistent_workers=workers > 0,
    )  # fmt: skip
