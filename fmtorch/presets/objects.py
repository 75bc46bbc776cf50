"""From configs to objects: a mapping with a `_target_` becomes what the target makes of its other entries."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import hydra.utils
import torch
from omegaconf import DictConfig, OmegaConf

from fmtorch.core.options import expect_options
from fmtorch.presets.files import load


def build(group: str, name: str, config_dir: Path | str | None = None, **options: Any) -> Any:
    """The object that a preset describes, with some of its options replaced.

    Where an option is itself an object, its own are replaced: ``build("estimator", "cf_ransac", fine={"round": 100})``.
    Raises ValueError for an unknown preset or option, naming those that exist.
    """
    return instantiate(merged(load(group, name, config_dir), options), where=f"{group}={name}")


def merged(config: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """`config` with the values of `options`, mappings merged level by level."""
    changes = {
        key: merged(before, value) if isinstance(value, Mapping) and isinstance(before, Mapping) else value
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


def open_files(part: Any, device: torch.device) -> None:
    """Have this project's parts read their learned files now, at any depth, where they have an `open_file`.

    Raises ValueError, naming the file, where one cannot be used.
    """
    if hasattr(part, "open_file"):
        part.open_file(device)
    elif isinstance(part, Mapping | list | tuple):
        for each in part.values() if isinstance(part, Mapping) else part:
            open_files(each, device)
    elif type(part).__module__.partition(".")[0] == "fmtorch" and not isinstance(part, torch.nn.Module):
        open_files(list(getattr(part, "__dict__", {}).values()), device)
