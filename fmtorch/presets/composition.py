"""Configs composed from groups of presets, as the commands compose them, and the pipelines that they describe."""

from __future__ import annotations

import functools
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from fmtorch.core.files import STAGES, conf_dir
from fmtorch.presets import hydra_source
from fmtorch.presets.files import available
from fmtorch.presets.objects import expect_buildable
from fmtorch.presets.pruners import expect_pruners, pruner_configs, with_explicit

_composing = threading.Lock()  # Hydra composes through a global
hydra_source.register()
PIPELINES = "pipelines"  # the config that a pipeline alone is composed from
_DEFAULTS = [*({group: name} for group, name in STAGES.items()), {"pipeline": "sift_ratio"}, "_self_"]
ConfigStore.instance().store(PIPELINES, {"defaults": _DEFAULTS, "cache": None, "cache_limit": 20})


def stages(config: DictConfig) -> dict[str, Any]:
    """What a composed config says of each group of `STAGES`, as plain values.

    Pruners are a list of mappings of one name each, in the order in which they run, which decides results and which no
    mapping keeps on its way through JSON with sorted keys.
    """
    plain = {group: OmegaConf.to_container(config[group], resolve=True) for group in STAGES if config.get(group)}
    return {**plain, "pruner": [{name: value} for name, value in pruner_configs(config).items()]}


def plain(config: Any) -> dict[str, Any]:
    """A part of a config as a dictionary without interpolations; empty for null."""
    container = OmegaConf.to_container(config, resolve=True) if isinstance(config, DictConfig) else {}
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


@functools.cache
def pipeline_stages(name: str) -> dict[str, Any] | None:
    """The `stages` of the project's own pipeline `name`, unchanged; None where it has no such pipeline."""
    return stages(compose(PIPELINES, (f"pipeline={name}",))) if name in available("pipeline") else None


def composed(stages: Mapping[str, Any]) -> dict[str, Any]:
    """The config that `stages` was made of."""
    pruners = stages.get("pruner") or []
    return {**stages, "pruner": {name: value for entry in pruners for name, value in entry.items()}}


def expect_stages(config: DictConfig) -> None:
    """Raises ValueError, naming the option, where a stage of a composed config cannot be built with its options."""
    for group in STAGES:
        if group != "pruner" and group in config:  # a training has no estimator
            expect_buildable(plain(config[group]), group)
    expect_pruners(config)


def compose(config_name: str, overrides: Sequence[str], config_dir: Path | None = None) -> DictConfig:
    """The config that a command composes from its arguments; a caller's own Hydra stays as it is.

    config_dir: a folder with a user's presets, which are read anew.
    """
    return _kept(config_name, tuple(overrides)) if config_dir is None else _composed(config_name, overrides, config_dir)


@functools.lru_cache(maxsize=64)
def _kept(config_name: str, overrides: tuple[str, ...]) -> DictConfig:
    return _composed(config_name, overrides)


def _composed(config_name: str, overrides: Sequence[str], config_dir: Path | None = None) -> DictConfig:
    own = [] if config_dir is None else [f"hydra.searchpath=['file://{config_dir.resolve()}']"]
    with _composing:
        hydra_of_caller, GlobalHydra.instance().hydra = GlobalHydra.instance().hydra, None
        try:
            with hydra.initialize_config_dir(str(conf_dir()), version_base=None):
                return with_explicit(hydra.compose(config_name, [*own, *overrides]), overrides)
        finally:
            GlobalHydra.instance().hydra = hydra_of_caller
