"""Preset files, ``conf/<group>/<name>.yaml``: which there are, what they say and what they name."""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import hydra.utils
import yaml  # type: ignore[import-untyped]
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from fmtorch.core.options import nearest
from fmtorch.core.resources import conf_dir
from fmtorch.presets.former import moved


def available(group: str, config_dir: Path | str | None = None) -> list[str]:
    """Names of the presets of a group, e.g. ``available("estimator")``: ``paper/usac`` and the like last."""
    folders = [Path(config_dir) / group] if config_dir is not None else []
    paths = [path.relative_to(f).with_suffix("") for f in [*folders, conf_dir() / group] for path in f.rglob("*.yaml")]
    return sorted({path.as_posix() for path in paths}, key=lambda name: (name.count("/"), name))


def groups() -> list[str]:
    """Names of the groups of presets."""
    return sorted(path.name for path in conf_dir().iterdir() if any(path.glob("*.yaml")) and path.name != "hydra")


def summary(path: Path) -> str:
    """The first sentence of the comment at the top of a preset file."""
    lines = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            lines.append(line.removeprefix("#").strip())
    return re.split(r"(?<!al)\.(?=\s|$)", " ".join(lines))[0]


def load(group: str, name: str, config_dir: Path | str | None = None) -> dict[str, Any]:
    """The contents of one preset file; files in `config_dir` come before the project's own.

    Raises ValueError with the available names where there is no such preset.
    """
    folders = [Path(config_dir)] if config_dir is not None else []
    for folder in [*folders, conf_dir()]:
        path = folder / group / f"{name}.yaml"
        if path.is_file():
            with naming_file(path):
                values = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
            if not isinstance(values, dict):
                raise ValueError(f"{path}: a preset is a mapping with a `_target_`, the dotted name of what it builds")
            return {str(key): value for key, value in values.items()}
    raise ValueError(unknown(group, name, config_dir))


def unknown(group: str, name: str, config_dir: Path | str | None = None) -> str:
    """What is said of a preset that there is not: where it went, or which there are."""
    there_are = nearest(name, available(group, config_dir))
    return moved(group, name) or f"no preset {name!r} in conf/{group}; there are: {there_are}"


@contextlib.contextmanager
def naming_file(path: Path | str) -> Iterator[None]:
    """Raises ValueError that begins with the file's path where reading it as YAML fails."""
    try:
        yield
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}: "
        raise ValueError(f"{path}: {line}{error.problem or error.context}; a preset is a mapping in YAML") from error
    except OmegaConfBaseException as error:
        raise ValueError(f"{path}: {str(error).partition(chr(10))[0]}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: no text in UTF-8; a preset is a mapping in YAML") from error


@functools.cache
def known_targets() -> frozenset[str]:
    """What the project's own presets build: dotted names that are safe to take from a file."""
    texts = [path.read_text(encoding="utf-8") for path in conf_dir().glob("*/**/*.yaml")]
    return frozenset(name for text in texts for name in re.findall(r"\b_target_: *([\w.]+)", text))


def closest(group: str, config: Mapping[str, Any]) -> tuple[str, dict[str, Any]] | None:
    """The project's preset of a group from which a config differs least, and the options in which it does.

    None where no preset builds what the config does, or the options are not those of the preset.
    """
    candidates = []
    for name, preset in _shipped(group).items():
        if preset.get("_target_") == config.get("_target_") and preset.keys() >= config.keys():
            candidates.append((name, {key: value for key, value in config.items() if preset[key] != value}))
    return min(candidates, key=lambda pair: len(pair[1]), default=None)


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


def peer_packages(config: object) -> list[str]:
    """The packages of other libraries whose versions decide what the targets within a config compute, sorted."""
    packages = {getattr(hydra.utils.get_object(target), "peer_package", None) for target in targets_of(config)}
    return sorted(package for package in packages if package)


def own_modules(config: object) -> dict[str, str]:
    """The modules that define the targets within a config that are none of this project's, by the targets' names."""
    own = sorted(name for name in targets_of(config) if name.partition(".")[0] != "fmtorch")
    return {
        name: str(getattr(hydra.utils.get_object(name), "__module__", None) or name.rpartition(".")[0]) for name in own
    }
