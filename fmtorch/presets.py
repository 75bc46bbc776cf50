"""Presets: the flat YAML files of ``conf/<group>/<name>.yaml``, loaded by name and built into objects.

With the commands this is the only user of Hydra and OmegaConf.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import hydra.utils
from omegaconf import DictConfig, OmegaConf

from fmtorch.resources import conf_dir


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
    raise ValueError(f"no preset {name!r} in conf/{group}; there are: {', '.join(available(group, config_dir))}")


def build(group: str, name: str, config_dir: Path | str | None = None, **options: Any) -> Any:
    """The object that a preset describes, with some of its options replaced.

    Raises ValueError for an unknown preset or option, naming those that exist.
    """
    return instantiate({**load(group, name, config_dir), **options}, where=f"{group}={name}")


def instantiate(config: Mapping[str, Any] | DictConfig, where: str, **extra: Any) -> Any:
    """The object of a flat config with a `_target_`; `where` names the config in errors, `extra` arguments are added.

    Raises ValueError for an unknown option, naming those that exist; what the target itself raises passes through.
    """
    values = OmegaConf.to_container(config, resolve=True) if isinstance(config, DictConfig) else dict(config)
    if not isinstance(values, dict) or "_target_" not in values:
        raise ValueError(f"{where}: a preset is a mapping with a `_target_`, the dotted name of what it builds")
    target = hydra.utils.get_object(str(values.pop("_target_")))
    known = inspect.signature(target).parameters
    takes_any = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in known.values())
    unknown = [str(key) for key in values if key not in known]
    if unknown and not takes_any:
        raise ValueError(f"{where}: no option {', '.join(unknown)}; there are: {', '.join(known)}")
    return target(**{str(key): value for key, value in values.items()}, **extra)
