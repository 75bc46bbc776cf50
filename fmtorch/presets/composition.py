"""Configs composed from groups of presets, as the commands compose them, and the pipelines that they describe."""

from __future__ import annotations

import functools
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
import hydra.utils
import torch
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from fmtorch import data
from fmtorch.core.resources import STAGES as STAGES
from fmtorch.core.resources import conf_dir
from fmtorch.presets import hydra_source
from fmtorch.presets.files import available, unknown
from fmtorch.presets.former import FORMER, Now
from fmtorch.presets.objects import expect_buildable, instantiate, open_files, plain
from fmtorch.presets.pruners import build_pruners, expect_pruners, pruner_configs, with_explicit
from fmtorch.storage.features import cached

PIPELINE = "fmtorch.pipeline.pipeline.Pipeline"  # by name, as the stages: presets know nothing of what they build
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


@functools.cache
def pipeline_stages(name: str) -> dict[str, Any] | None:
    """The `stages` of the project's own pipeline `name`, unchanged; None where it has, and had, no such pipeline."""
    now = FORMER["pipeline"].get(name, Now(name))
    known = now.name in available("pipeline")
    return stages(compose(PIPELINES, (f"pipeline={now.name}", *now.overrides))) if known else None


def composed(stages: Mapping[str, Any]) -> dict[str, Any]:
    """The config that `stages` was made of. Raises ValueError where several pruners stand in no order."""
    pruners = stages.get("pruner") or []
    if isinstance(pruners, Mapping):  # of a version that did not keep the order
        if len(pruners) > 1:
            raise ValueError(f"the order of its pruners ({', '.join(pruners)}) is not known; evaluate it again")
        pruners = [pruners]
    return {**stages, "pruner": {name: _of_now(value) for entry in pruners for name, value in entry.items()}}


def _of_now(pruner: Any) -> Any:
    """A pruner's options with those renamed that earlier versions called otherwise."""
    if not isinstance(pruner, Mapping) or "prune" not in pruner:
        return pruner
    return {**{key: value for key, value in pruner.items() if key != "prune"}, "soft": not pruner["prune"]}


def expect_stages(config: DictConfig) -> None:
    """Raises ValueError, naming the option, where a stage of a composed config cannot be built with its options."""
    for group in STAGES:
        if group != "pruner" and group in config:  # a training has no estimator
            expect_buildable(plain(config[group]), group)
    expect_pruners(config)


def expect_dataset(config: DictConfig) -> None:
    """Raises ValueError, naming the option, where a data set cannot be loaded with the options of its config."""
    options = plain(config)
    if "_target_" in options:
        expect_buildable(options, "dataset")
    else:
        data.expect_loadable(**options)


def build_pipeline(config: DictConfig, device: torch.device | str = "cpu", model: str | None = "fundamental") -> Any:
    """The `Pipeline` that features (with cache), matcher, pruner and estimator of a composed config describe.

    model: what the estimator must give, "fundamental" or "homography"; None: either.
    """
    extractor = cached(instantiate(config.features, "features"), config.cache, config.cache_limit)
    pruners, for_families = build_pruners(config)
    open_files([extractor, pruners, for_families], torch.device(device))  # a damaged one is no failure of each pair
    return hydra.utils.get_object(PIPELINE)(
        extractor,
        instantiate(config.matcher, "matcher"),
        pruners,
        instantiate(config.estimator, "estimator"),
        device=device,
        families=for_families,
        model=model,
    )


def pipeline(
    name: str,
    device: torch.device | str = "cpu",
    overrides: Sequence[str] = (),
    config_dir: Path | str | None = None,
) -> Any:
    """The `Pipeline` of ``conf/pipeline/<name>.yaml``, changed by `overrides` as on the command line.

    E.g. ``pipeline("sift_gms", overrides=["estimator=lmeds", "pruner.gms.with_scale=true"])``. Unlike the commands it
    keeps no features on disk unless asked to (``overrides=["cache=null"]``, or a folder).

    Args:
        name: a preset of conf/pipeline, or of `config_dir`.
        device: where features are described and everything behind them is computed.
        overrides: as words of a command.
        config_dir: a folder with presets of your own, as the commands take it by `--config-dir`.

    Raises:
        ValueError: for an unknown pipeline, naming those there are, for an override that does not apply, and where
            `config_dir` is no folder.
    """
    if config_dir is not None and not Path(config_dir).is_dir():
        raise ValueError(f"config_dir={config_dir} is no folder")
    if name not in available("pipeline", config_dir):
        raise ValueError(unknown("pipeline", name, config_dir))
    words = (f"pipeline={name}", "cache=off", *overrides)
    try:
        config = compose(PIPELINES, words) if config_dir is None else _composed(PIPELINES, words, Path(config_dir))
    except HydraException as error:
        raise ValueError(f"pipeline={name} with {', '.join(overrides)}: {error}") from error
    return build_pipeline(config, device)


@functools.lru_cache(maxsize=64)
def compose(config_name: str, overrides: tuple[str, ...]) -> DictConfig:
    """The config that a command composes from its arguments; a caller's own Hydra stays as it is."""
    return _composed(config_name, overrides)


def _composed(config_name: str, overrides: Sequence[str], config_dir: Path | None = None) -> DictConfig:
    """The same, read anew, with a user's presets."""
    own = [] if config_dir is None else [f"hydra.searchpath=['file://{config_dir.resolve()}']"]
    with _composing:
        hydra_of_caller, GlobalHydra.instance().hydra = GlobalHydra.instance().hydra, None
        try:
            with hydra.initialize_config_dir(str(conf_dir()), version_base=None):
                return with_explicit(hydra.compose(config_name, [*own, *overrides]), overrides)
        finally:
            GlobalHydra.instance().hydra = hydra_of_caller
