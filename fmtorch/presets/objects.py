"""From configs to objects: a mapping with a `_target_` becomes what the target makes of its other entries."""

import importlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import torch

from fmtorch.core import expect_options, own_traceback
from fmtorch.presets.files import load, targets_of

T = TypeVar("T")


def build(group: str, name: str, config_dir: Path | str | None = None, **options: Any) -> Any:
    """The object that a preset describes, with some of its options replaced.
    Where an option is itself an object, its own are replaced: ``build("estimator", "cf_ransac", fine={"round": 100})``.
    Raises ValueError for an unknown preset or option, naming those that exist."""
    return instantiate(merged(load(group, name, config_dir), options), where=f"{group}={name}")


def merged(config: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """`config` with the values of `options`, mappings merged level by level."""
    nested = [k for k, v in options.items() if isinstance(v, Mapping) and isinstance(config.get(k), Mapping)]
    return {**config, **options, **{key: merged(config[key], options[key]) for key in nested}}


def instantiate(config: Mapping[str, Any], where: str, **extra: Any) -> Any:
    """The object of a config with a `_target_`; `where` names the config in errors, `extra` arguments are added.
    A value that is a mapping with a `_target_` of its own becomes an object first. Raises ValueError where
    `expect_buildable` does; what the target itself raises passes through."""
    return construct(target_of(config, where), config, where, **extra)


def construct(make: Callable[..., T], config: Mapping[str, Any], where: str, **extra: Any) -> T:
    """The same with the target given: of the entries of a config but for its `_target_`."""
    expect_buildable(config, where, extra, make)
    return _constructed(make, config, where, extra)


def expect_buildable(
    config: Mapping[str, Any], where: str, given: Iterable[str] = (), make: Callable[..., Any] | None = None
) -> None:
    """Raises ValueError, naming the option, where a config, or one within it, does not fit its target's signature.
    given: names of arguments that are added later. make: in place of the target."""
    values = {str(key): value for key, value in config.items() if key != "_target_"}
    expect_options(make or target_of(config, where), values, where, given)
    for key, value in values.items():
        if _is_object(value):
            expect_buildable(value, f"{where}.{key}")


def _constructed(make: Callable[..., T], config: Mapping[str, Any], where: str, extra: Mapping[str, Any]) -> T:
    built = {
        str(key): _constructed(target_of(value, place), value, place, {}) if _is_object(value) else value
        for key, value, place in ((key, value, f"{where}.{key}") for key, value in config.items() if key != "_target_")
    }
    try:
        return make(**built, **extra)
    except Exception as error:
        if own_traceback(error) and not isinstance(error, ValueError | TypeError | OSError | ImportError):
            raise ValueError(f"{where}: {type(error).__name__}: {error}") from error
        raise


def _is_object(value: object) -> bool:
    return isinstance(value, Mapping) and "_target_" in value


def target_of(config: Mapping[str, Any], where: str) -> Callable[..., Any]:
    """What the `_target_` of a config names. Raises ValueError where there is none, or it cannot be imported."""
    if not _is_object(config):
        raise ValueError(f"{where}: a preset is a mapping with a `_target_`, the dotted name of what it builds")
    name = str(config["_target_"])
    try:
        target: Callable[..., Any] = _located(name)
    except Exception as error:  # what a module of a user's raises while it is imported
        raise ValueError(f"{where}: _target_={name} cannot be imported: {' '.join(str(error).split())}") from error
    return target


def _located(name: str) -> Any:
    parts = name.split(".")
    value: Any = importlib.import_module(parts[0])
    for i, part in enumerate(parts[1:], start=2):
        try:
            value = getattr(value, part)
        except AttributeError:
            if not isinstance(value, ModuleType):
                raise
            value = importlib.import_module(".".join(parts[:i]))
    return value


def peer_packages(config: object) -> list[str]:
    """The packages of other libraries whose versions decide what the targets within a config compute, sorted."""
    packages = {getattr(_located(target), "peer_package", None) for target in targets_of(config)}
    return sorted(package for package in packages if package)


def own_modules(config: object) -> dict[str, str]:
    """The modules that define the targets within a config that are none of this project's, by the targets' names."""
    own = sorted(name for name in targets_of(config) if name.partition(".")[0] != "fmtorch")
    return {name: str(getattr(_located(name), "__module__", None) or name.rpartition(".")[0]) for name in own}


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
    Raises ValueError, naming the file, where one cannot be used."""
    if hasattr(part, "open_file"):
        part.open_file(device)
    elif isinstance(part, Mapping | list | tuple):
        for each in part.values() if isinstance(part, Mapping) else part:
            open_files(each, device)
    elif type(part).__module__.partition(".")[0] == "fmtorch" and not isinstance(part, torch.nn.Module):
        open_files(list(getattr(part, "__dict__", {}).values()), device)
