"""Presets: the flat YAML files of ``conf/<group>/<name>.yaml``, loaded by name and built into objects.

With the commands this is the only user of Hydra and OmegaConf.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
import hydra.utils
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from fmtorch import data, hydra_source
from fmtorch.options import expect_options, nearest
from fmtorch.pipeline import Pipeline
from fmtorch.resources import conf_dir
from fmtorch.storage.features import cached

STAGES = ("features", "matcher", "pruner", "estimator")  # groups that a pipeline chooses from
_composing = threading.Lock()  # Hydra composes through a global
hydra_source.register()


def available(group: str, config_dir: Path | str | None = None) -> list[str]:
    """Names of the presets of a group, e.g. ``available("estimator")``."""
    folders = [Path(config_dir) / group] if config_dir is not None else []
    return sorted({path.stem for folder in [*folders, conf_dir() / group] for path in folder.glob("*.yaml")})


def load(group: str, name: str, config_dir: Path | str | None = None) -> dict[str, Any]:
    """The contents of one preset file; files in `config_dir` come before the project's own.

    Raises ValueError with the available names where there is no such preset.
    """
    folders = [Path(config_dir)] if config_dir is not None else []
    for folder in [*folders, conf_dir()]:
        path = folder / group / f"{name}.yaml"
        if path.is_file():
            values = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
            if not isinstance(values, dict):
                raise ValueError(f"{path}: a preset is a mapping with a `_target_`, the dotted name of what it builds")
            return {str(key): value for key, value in values.items()}
    raise ValueError(f"no preset {name!r} in conf/{group}; there are: {nearest(name, available(group, config_dir))}")


@functools.cache
def known_targets() -> frozenset[str]:
    """What the project's own presets build: dotted names that are safe to take from a file."""
    files = conf_dir().glob("*/*.yaml")
    return frozenset().union(*(targets_of(OmegaConf.to_container(OmegaConf.load(path))) for path in files))


def closest(group: str, config: Mapping[str, Any]) -> tuple[str, dict[str, Any]] | None:
    """The project's preset of a group from which a config differs least, and the options in which it does.

    None where no preset builds what the config does, or the options are not those of the preset.
    """
    found = []
    for name, preset in _shipped(group).items():
        if preset.get("_target_") == config.get("_target_") and preset.keys() >= config.keys():
            found.append((name, {key: value for key, value in config.items() if preset[key] != value}))
    return min(found, key=lambda pair: len(pair[1]), default=None)


@functools.cache
def _shipped(group: str) -> dict[str, dict[str, Any]]:
    """The project's own presets of a group, by name."""
    return {name: load(group, name) for name in available(group)}


def targets_of(config: object) -> frozenset[str]:
    """The `_target_`s anywhere within a config."""
    if isinstance(config, Mapping):
        own = [str(config["_target_"])] if "_target_" in config else []
        return frozenset(own).union(*(targets_of(value) for value in config.values()))
    if isinstance(config, list):
        return frozenset().union(*(targets_of(value) for value in config))
    return frozenset()


def own_modules(config: object) -> dict[str, str]:
    """The modules that define the targets within a config that are none of this project's, by the targets' names."""
    own = sorted(name for name in targets_of(config) if name.partition(".")[0] != "fmtorch")
    return {
        name: str(getattr(hydra.utils.get_object(name), "__module__", None) or name.rpartition(".")[0]) for name in own
    }


def build(group: str, name: str, config_dir: Path | str | None = None, **options: Any) -> Any:
    """The object that a preset describes, with some of its options replaced.

    Where an option is itself an object, its own are replaced: ``build("estimator", "cf_ransac", fine={"round": 100})``.
    Raises ValueError for an unknown preset or option, naming those that exist.
    """
    return instantiate(_merged(load(group, name, config_dir), options), where=f"{group}={name}")


def _merged(config: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """`config` with the values of `options`, mappings merged level by level."""
    changes = {
        key: _merged(before, value) if isinstance(value, Mapping) and isinstance(before, Mapping) else value
        for key, value, before in ((key, value, config.get(key)) for key, value in options.items())
    }
    return {**config, **changes}


def plain(config: Any) -> dict[str, Any]:
    """A part of a config as a dictionary without interpolations; empty for null."""
    container = OmegaConf.to_container(config, resolve=True) if isinstance(config, DictConfig) else {}
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


def instantiate(config: Mapping[str, Any] | DictConfig, where: str, **extra: Any) -> Any:
    """The object of a config with a `_target_`; `where` names the config in errors, `extra` arguments are added.

    A value that is a mapping with a `_target_` of its own becomes an object first.
    Raises ValueError where `expect_buildable` does; what the target itself raises passes through.
    """
    values = plain(config) if isinstance(config, DictConfig) else config
    expect_buildable(values, where, extra)
    return _instantiated(values, where, extra)


def expect_buildable(config: Mapping[str, Any], where: str, given: Iterable[str] = ()) -> None:
    """Raises ValueError, naming the option, where a config, or one within it, does not fit its target's signature."""
    if not isinstance(config, Mapping) or "_target_" not in config:
        raise ValueError(f"{where}: a preset is a mapping with a `_target_`, the dotted name of what it builds")
    values = {str(key): value for key, value in config.items() if key != "_target_"}
    expect_options(_target(config, where), values, where, given)
    for key, value in values.items():
        if _is_object(value):
            expect_buildable(value, f"{where}.{key}")


def _is_object(value: object) -> bool:
    return isinstance(value, Mapping) and "_target_" in value


def _target(config: Mapping[str, Any], where: str) -> Callable[..., Any]:
    name = str(config["_target_"])
    try:
        target: Callable[..., Any] = hydra.utils.get_object(name)
    except (ImportError, ValueError) as error:
        cause = " ".join(str(error.__cause__ or error).split())
        raise ValueError(f"{where}: _target_={name} cannot be imported: {cause}") from error
    return target


def _instantiated(config: Mapping[str, Any], where: str, extra: Mapping[str, Any]) -> Any:
    built = {
        str(key): _instantiated(value, f"{where}.{key}", {}) if _is_object(value) else value
        for key, value in config.items()
        if key != "_target_"
    }
    return _target(config, where)(**built, **extra)


def resolve_device(name: str) -> torch.device:
    """The torch device of a config: `auto` takes a GPU where there is one. Raises ValueError where it is not there."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ValueError(f"device={name}; it must be auto, cpu, cuda, cuda:1 or mps") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device={name}: this installation of torch sees no CUDA device; use device=cpu")
    return device


def stages(config: DictConfig) -> dict[str, Any]:
    """What a composed config says of each group of `STAGES`, as plain values.

    Pruners are a list of mappings of one name each, in the order in which they run, which decides results and which no
    mapping keeps on its way through JSON with sorted keys.
    """
    plain = {group: OmegaConf.to_container(config[group], resolve=True) for group in STAGES if config.get(group)}
    return {**plain, "pruner": [{name: value} for name, value in _pruners(config).items()]}


@functools.cache
def pipeline_stages(name: str) -> dict[str, Any] | None:
    """The `stages` of the project's own pipeline `name`, unchanged; None where it has no such pipeline."""
    return stages(_compose("match", (f"pipeline={name}",))) if name in available("pipeline") else None


def composed(stages: Mapping[str, Any]) -> dict[str, Any]:
    """The config that `stages` was made of. Raises ValueError where several pruners stand in no order."""
    pruners = stages.get("pruner") or []
    if isinstance(pruners, Mapping):  # of a version that did not keep the order
        if len(pruners) > 1:
            raise ValueError(f"the order of its pruners ({', '.join(pruners)}) is not known; evaluate it again")
        pruners = [pruners]
    return {**stages, "pruner": {name: value for entry in pruners for name, value in entry.items()}}


def top_level_names(config_name: str) -> list[str]:
    """What the command of this config takes by name: its fields and the groups it chooses from."""
    fields = OmegaConf.load(conf_dir() / f"{config_name}.yaml")
    assert isinstance(fields, DictConfig)
    groups = [str(group) for entry in fields.get("defaults", []) if entry != "_self_" for group in entry]
    return [name for name in (*map(str, fields), *groups) if name not in ("defaults", "hydra") and " " not in name]


def _pruners(config: DictConfig) -> dict[str, Any]:
    """The pruners' configs by name, in the order in which they run."""
    if not config.get("pruner"):
        return {}
    plain = OmegaConf.to_container(config.pruner, resolve=True)
    assert isinstance(plain, dict)
    if "_target_" in plain:
        raise ValueError(
            "pruner: a `_target_` stands where the names of pruners belong; the `# @package` line of a preset of yours "
            "must be `# @package pruner.<name>`, or be left out"
        )
    return {str(name): value for name, value in plain.items()}


def expect_stages(config: DictConfig) -> None:
    """Raises ValueError, naming the option, where a stage of a composed config cannot be built with its options."""
    for group in STAGES:
        if group != "pruner" and group in config:  # a training has no estimator
            expect_buildable(plain(config[group]), group)
    for name, value in _pruners(config).items():
        expect_buildable(value, f"pruner.{name}")


def expect_dataset(config: DictConfig) -> None:
    """Raises ValueError, naming the option, where a data set cannot be loaded with the options of its config."""
    options = plain(config)
    if "_target_" in options:
        expect_buildable(options, "dataset")
    else:
        data.expect_loadable(**options)


def build_pipeline(config: DictConfig, device: torch.device | str = "cpu") -> Pipeline:
    """The pipeline that features (with cache), matcher, pruner and estimator of a composed config describe."""
    extractor = cached(instantiate(config.features, "features"), config.cache, config.cache_limit)
    pruners = {name: instantiate(value, f"pruner.{name}") for name, value in _pruners(config).items()}
    return Pipeline(
        extractor,
        instantiate(config.matcher, "matcher"),
        pruners,
        instantiate(config.estimator, "estimator"),
        device=device,
    )


def pipeline(
    name: str,
    device: torch.device | str = "cpu",
    overrides: Sequence[str] = (),
    config_dir: Path | str | None = None,
) -> Pipeline:
    """The pipeline of ``conf/pipeline/<name>.yaml``, changed by `overrides` as on the command line.

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
    known = available("pipeline", config_dir)
    if name not in known:
        raise ValueError(f"no preset {name!r} in conf/pipeline; there are: {nearest(name, known)}")
    words = (f"pipeline={name}", "cache=off", *overrides)
    try:
        config = _compose("match", words) if config_dir is None else _composed("match", words, Path(config_dir))
    except HydraException as error:
        raise ValueError(f"pipeline={name} with {', '.join(overrides)}: {error}") from error
    return build_pipeline(config, device)


@functools.lru_cache(maxsize=64)
def _compose(config_name: str, overrides: tuple[str, ...]) -> DictConfig:
    """The config that a command composes from its arguments; a caller's own Hydra stays as it is."""
    return _composed(config_name, overrides)


def _composed(config_name: str, overrides: Sequence[str], config_dir: Path | None = None) -> DictConfig:
    """The same, read anew, with a user's presets."""
    own = [] if config_dir is None else [f"hydra.searchpath=['file://{config_dir.resolve()}']"]
    with _composing:
        hydra_of_caller, GlobalHydra.instance().hydra = GlobalHydra.instance().hydra, None
        try:
            with hydra.initialize_config_dir(str(conf_dir()), version_base=None):
                return hydra.compose(config_name, [*own, *overrides])
        finally:
            GlobalHydra.instance().hydra = hydra_of_caller
