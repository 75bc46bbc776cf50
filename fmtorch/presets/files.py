"""Preset files, ``conf/<group>/<name>.yaml``: which there are, what they say and what they name."""

import contextlib
import functools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from fmtorch.core.files import conf_dir
from fmtorch.core.options import nearest


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
    Raises ValueError with the available names where there is no such preset."""
    folders = [Path(config_dir)] if config_dir is not None else []
    for folder in [*folders, conf_dir()]:
        path = folder / group / f"{name}.yaml"
        if path.is_file():
            with naming_file(path):
                values = _read(path)
            if not isinstance(values, dict):
                raise ValueError(f"{path}: a preset is a mapping with a `_target_`, the dotted name of what it builds")
            return {str(key): value for key, value in values.items()}
    raise ValueError(unknown(group, name, config_dir))


def unknown(group: str, name: str, config_dir: Path | str | None = None) -> str:
    """What is said of a preset that there is not."""
    return f"no preset {name!r} in conf/{group}; there are: {nearest(name, available(group, config_dir))}"


def _read(path: Path) -> Any:
    text = path.read_text(encoding="utf-8")
    values = yaml.load(text, _Loader)
    if "${" not in text:
        return values
    from omegaconf import OmegaConf  # for presets of a user's whose options refer to others or to the environment
    from omegaconf.errors import OmegaConfBaseException

    try:
        return OmegaConf.to_container(OmegaConf.create(values), resolve=True)
    except OmegaConfBaseException as error:
        raise ValueError(f"{path}: {str(error).partition(chr(10))[0]}") from error


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """YAML as OmegaConf reads it: 1e-3 is a number, a date is text, and a mapping has no key twice."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys = [key.value for key, _ in node.value]
        for i, (key, _) in enumerate(node.value):
            if key.value in keys[:i]:
                raise yaml.constructor.ConstructorError(
                    "while constructing a mapping", node.start_mark, f"found duplicate key {key.value}", key.start_mark
                )
        return super().construct_mapping(node, deep=deep)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
    for first, resolvers in _Loader.yaml_implicit_resolvers.items()
}
_EXPONENT = re.compile(r"[-+]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)[eE][-+]?\d+$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+.0123456789"))


@contextlib.contextmanager
def naming_file(path: Path | str) -> Iterator[None]:
    """Raises ValueError that begins with the file's path where reading it as YAML fails."""
    try:
        yield
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}: "
        raise ValueError(f"{path}: {line}{error.problem or error.context}; a preset is a mapping in YAML") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: no text in UTF-8; a preset is a mapping in YAML") from error


@functools.cache
def known_targets() -> frozenset[str]:
    """What the project's own presets build: dotted names that are safe to take from a file."""
    texts = [path.read_text(encoding="utf-8") for path in conf_dir().glob("*/**/*.yaml")]
    return frozenset(name for text in texts for name in re.findall(r"\b_target_: *([\w.]+)", text))


def closest(group: str, config: Mapping[str, Any]) -> tuple[str, dict[str, Any]] | None:
    """The project's preset of a group from which a config differs least, and the options in which it does.
    None where no preset builds what the config does, or the options are not those of the preset."""
    candidates = []
    for name, preset in _shipped(group).items():
        if preset.get("_target_") == config.get("_target_") and preset.keys() >= config.keys():
            candidates.append((name, {key: value for key, value in config.items() if preset[key] != value}))
    return min(candidates, key=lambda pair: len(pair[1]), default=None)


@functools.cache
def _shipped(group: str) -> dict[str, dict[str, Any]]:
    return {name: load(group, name) for name in available(group)}


def targets_of(config: object) -> frozenset[str]:
    """The `_target_`s anywhere within a config."""
    if isinstance(config, Mapping):
        own = [str(config["_target_"])] if "_target_" in config else []
        return frozenset(own).union(*(targets_of(value) for value in config.values()))
    if isinstance(config, list):
        return frozenset().union(*(targets_of(value) for value in config))
    return frozenset()
