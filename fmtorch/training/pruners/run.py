"""A composed config of `fmtorch.train` -> a trained network, its files and its card."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.progress import Progress

from fmtorch import data, presets
from fmtorch.command import console, plain, progress_bar
from fmtorch.data import PairDataset
from fmtorch.evaluation.run import select
from fmtorch.matched import Augmentation, MatchedPairs, held_out_scenes
from fmtorch.pipeline import Pipeline
from fmtorch.storage.features import cached
from fmtorch.storage.runs import identity_digest
from fmtorch.training.pruners.batches import training_batches
from fmtorch.training.pruners.loop import claim, train
from fmtorch.training.pruners.module import Optimisation, PrunerTraining
from fmtorch.training.pruners.objective import Objective
from fmtorch.training.pruners.pictures import ValidationPicture
from fmtorch.training.pruners.result import write_result
from fmtorch.training.pruners.validation import Use, Validation


def run(config: DictConfig, name: str) -> Path:
    """Train what a composed config describes and return the folder of the result; a finished one is returned at once.

    name: of the pruner's preset, e.g. ``lc``.
    """
    pruner = trained_pruner(config, name)
    optimisation, objective = Optimisation(**plain(config.optimisation)), Objective(**plain(config.objective))
    threads = config.threads or os.cpu_count() or 1
    with progress_bar() as progress:
        training, validation = matches(config, progress)
        identity = {
            "network": pruner["network"], "objective": plain(config.objective), "batch": config.batch,
            "optimisation": plain(config.optimisation), "augmentation": plain(config.augmentation), "seed": config.seed,
            "limit": config.limit, "training": training.digest, "validation": [part.digest for part in validation],
            "validation_options": plain(config.validation),
            "trainer": {key: value for key, value in plain(config.trainer).items() if key != "accelerator"},
        }  # fmt: skip
        folder = Path(config.output or f"runs/train/{name}-{identity_digest(identity)[:8]}")
        claim(folder, identity)
        ...
    return folder
