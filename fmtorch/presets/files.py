"""Preset files, ``conf/<group>/<name>.yaml``: which there are, what they say, and the objects that they become."""

import contextlib
import functools
import importlib
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import yaml  # type: ignore[import-untyped]

from fmtorch.core import expect_options, own_traceback
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
    comment = itertools.takewhile(lambda line: line.startswith("#"), path.read_text(encoding="utf-8").splitlines())
    text = " ".join(line.removeprefix("#").strip() for line in comment if not line.startswith("# @package"))
    return re.split(r"(?<!al)\.(?=\s|$)", text)[0]


def load(group: str, name: str, config_dir: Path | str | None = None) -> dict[str, Any]:
    """A preset's contents, of `config_dir` before the project's own. Raises ValueError with the names there are."""
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
    Mappings with a `_target_` become objects first. Raises as `expect_buildable`, and what the target raises."""
    return construct(target_of(config, where), config, where, **extra)


def construct(make: Callable[..., T], config: Mapping[str, Any], where: str, **extra: Any) -> T:
    """The same with the target given: of the entries of a config but for its `_target_`."""
    expect_buildable(config, where, extra, make)
    part = _constructed(make, config, where, extra)
    if part is None or isinstance(part, bool | int | float | str):
        raise ValueError(f"{where}: {config.get('_target_')} returned {part!r}, which is no part")
    return part


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
    except (Exception, SystemExit) as error:
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
    except (Exception, SystemExit) as error:  # what a module of a user's raises while it is imported
        raise ValueError(f"{where}: _target_={name} cannot be imported: {' '.join(str(error).split())}") from error
    if not callable(target):
        raise ValueError(f"{where}: _target_={name} is a {type(target).__name__}; it must name a class or a function")
    return target


def _located(name: str) -> Any:
    first, *parts = name.split(".")
    value: Any = importlib.import_module(first)
    for part in parts:
        if isinstance(value, ModuleType) and not hasattr(value, part):
            _import_module(value, part)
        value = getattr(value, part)
    return value


def _import_module(parent: ModuleType, part: str) -> None:
    name = f"{parent.__name__}.{part}"
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:  # what a module of this name needs
            raise
        own = vars(parent)
        names = [n for n in dir(parent) if not (n.startswith("_") or isinstance(own.get(n), ModuleType))]
        raise ImportError(f"module {parent.__name__} has no {part}; there are: {nearest(part, names)}") from error


def peer_packages(config: object) -> list[str]:
    """The packages of other libraries whose versions decide what the targets within a config compute, sorted."""
    packages = {getattr(_located(target), "peer_package", None) for target in targets_of(config)}
    return sorted(package for package in packages if package)


def own_modules(config: object) -> dict[str, str]:
    """The modules that define the targets within a config that are none of this project's, by the targets' names."""
    own = sorted(name for name in targets_of(config) if name.partition(".")[0] != "fmtorch")
    return {name: str(getattr(_located(name), "__module__", None) or name.rpartition(".")[0]) for name in own}
