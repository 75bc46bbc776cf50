"""Configs composed by Hydra from groups of presets, and what is read of them: stages, pruners, executor, device."""

import dataclasses
import functools
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar, cast, get_args, get_origin, get_type_hints

import hydra
import torch
from hydra._internal.core_plugins import file_config_source
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.errors import MissingConfigException
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf, open_dict

from fmtorch.core.files import STAGES, conf_dir
from fmtorch.core.options import Count, dataclass_in, expect_options, nearest
from fmtorch.core.stages import Pruner
from fmtorch.jobs.execution import Execution
from fmtorch.presets import files

LIGHTGLUE = "fmtorch.matching.lightglue.LightGlue"
SEVERAL = ("pruner",)  # groups of which several presets are chosen at once


class FileConfigSource(file_config_source.FileConfigSource):
    """Hydra's reader of config folders, which gives presets of such groups the package of their name.
    It has the name of the reader that it replaces: a launcher's processes register Hydra's own once more, which Hydra
    skips where one of the same name is there and refuses where it is of another."""

    def load_config(self, config_path: str) -> ConfigResult:
        with files.naming_file(Path(self.path) / self._normalize_file_name(config_path)):
            result = super().load_config(config_path)
        path = PurePosixPath(config_path)
        group = str(path.parent)
        if group in SEVERAL and result.header.get("package") in (None, "_group_", group):
            result.header["package"] = f"{group}.{path.name.removesuffix('.yaml')}"
        return result


FAMILIES = "families"  # among a pruner's options: family -> options that its pairs get instead
OF_PIPELINES = frozenset({FAMILIES, "soft"})  # options that pipelines' presets set, of pruners that may be replaced
WIDE_FAMILIES = "wide"  # stands there for every family of wide baselines
WIDE = (  # families of wide baselines; the others are taken for videos, whose baselines are short
    "Tanks_and_Temples", "CPC",  # of FM-Bench
    "Strecha", "Strecha_train", "PhotoTourism", "TanksLike",  # further photographs of unordered scenes
    "orbit", "collection",  # rendered
)  # fmt: skip


def pruner_configs(config: DictConfig) -> dict[str, Any]:
    """The pruners' configs by name, in the order in which they run.
    Raises ValueError where one pruner's options stand in the place of the names."""
    if not config.get("pruner"):
        return {}
    plain = OmegaConf.to_container(config.pruner, resolve=True)
    assert isinstance(plain, dict)
    if "_target_" in plain:
        raise ValueError(
            "pruner: a `_target_` stands where the names of pruners belong; the `# @package` line of a preset of yours "
            "must be `# @package pruner.<name>`, or be left out"
        )
    # A pipeline's preset may speak of a pruner that others have taken the place of
    left = [name for name, value in plain.items() if isinstance(value, Mapping) and value and {*value} <= OF_PIPELINES]
    return {str(name): value for name, value in plain.items() if name not in left}


def build_pruners(config: DictConfig) -> tuple[dict[str, Pruner], dict[str, dict[str, Pruner]]]:
    """The pruners by name, and by family those that pairs of this family get in their places."""
    usual: dict[str, Pruner] = {}
    for_families: dict[str, dict[str, Pruner]] = {}
    for name, value in pruner_configs(config).items():
        for where, options, families in _versions(name, value):
            pruner = files.instantiate(options, where)
            if not families:
                usual[name] = pruner
            for family in families:
                for_families.setdefault(family, {})[name] = pruner
    return usual, for_families


def with_explicit(config: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """A composed config in which an option of a pruner that was given explicitly holds for all families.
    A preset's options of families give way to it; those of a family that were given explicitly themselves stay.
    overrides: the words that it was composed with, e.g. ``pruner.gms.with_scale=false``."""
    words = [word for word in overrides if word.lstrip("+~").startswith("pruner.")]
    given = {path[1:] for word in words for path in _given(word)}
    changed = config
    for name, value in (config.get("pruner") or {}).items():
        families = value.get(FAMILIES) if isinstance(value, DictConfig) else None
        own = {path[1:] for path in given if path[0] == name}
        for family, options in families.items() if isinstance(families, DictConfig) else ():
            for option in options if isinstance(options, DictConfig) else ():
                explicit = (FAMILIES, str(family), str(option))
                stays = any(path == explicit[: len(path)] or path[:3] == explicit for path in own)
                if not stays and any(path[0] == option for path in own):
                    changed = changed.copy() if changed is config else changed
                    with open_dict(changed):
                        del changed.pruner[name][FAMILIES][family][option]
    return changed


def _given(override: str) -> Iterator[tuple[str, ...]]:
    """The paths of the options that an override gives: one, or those within a mapping."""
    parsed = OverridesParser.create().parse_override(override)

    def within(path: tuple[str, ...], value: Any) -> Iterator[tuple[str, ...]]:
        if isinstance(value, Mapping) and value:
            for key, inner in value.items():
                yield from within((*path, str(key)), inner)
        else:
            yield path

    yield from within(tuple(parsed.key_or_group.split(".")), parsed.value())


def _versions(name: str, config: Any) -> Iterator[tuple[str, Any, tuple[str, ...]]]:
    """Where the options of a pruner stand, the options, and the families that they are for: none, the usual ones first.
    Those of a family that is named come after those of all wide baselines, which they add to."""
    where = f"pruner.{name}"
    if not isinstance(config, Mapping) or FAMILIES not in config:
        yield where, config, ()
        return
    usual = {key: value for key, value in config.items() if key != FAMILIES}
    yield where, usual, ()
    families = config[FAMILIES] or {}
    if not isinstance(families, Mapping) or not all(isinstance(options, Mapping) for options in families.values()):
        what = "it must be a mapping of families to options, e.g. {wide: {with_scale: true}}"
        raise ValueError(f"{where}.{FAMILIES}={families}; {what}")
    wide = families.get(WIDE_FAMILIES, {})
    if WIDE_FAMILIES in families:
        yield f"{where}.{FAMILIES}.{WIDE_FAMILIES}", {**usual, **wide}, WIDE
    for family, options in families.items():
        if family != WIDE_FAMILIES:
            below = wide if family in WIDE else {}
            yield f"{where}.{FAMILIES}.{family}", {**usual, **below, **options}, (str(family),)


_composing = threading.Lock()  # Hydra composes through a global
Plugins.instance()  # registers Hydra's own readers of folders, of which this replaces one
SourcesRegistry.instance().types[FileConfigSource.scheme()] = FileConfigSource
PIPELINES = "pipelines"  # the config that a pipeline alone is composed from
_DEFAULTS = [*({group: name} for group, name in STAGES.items()), {"pipeline": "sift_ratio"}, "_self_"]
ConfigStore.instance().store(PIPELINES, {"defaults": _DEFAULTS, "cache": None, "cache_limit": 20})


def stages(config: DictConfig) -> dict[str, Any]:
    """What a composed config says of each group of `STAGES`, as plain values.
    Pruners are a list of mappings of one name each, in their order, which mappings lose in JSON of sorted keys."""
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
    return stages(compose(PIPELINES, (f"pipeline={name}",))) if name in files.available("pipeline") else None


def composed(stages: Mapping[str, Any]) -> dict[str, Any]:
    """The config that `stages` was made of."""
    pruners = stages.get("pruner") or []
    return {**stages, "pruner": {name: value for entry in pruners for name, value in entry.items()}}


def expect_stages(config: DictConfig) -> None:
    """Raises ValueError, naming the option, where a stage of a composed config cannot be built with its options, and
    where the features are others than this project's LightGlue is for."""
    room, _, kind = str(plain(config.get("features")).get("_target_")).rpartition(".")
    matcher, names = plain(config.get("matcher")), kind.lower() if room.endswith(".kornia_features") else "none"
    if matcher.get("_target_") == LIGHTGLUE and room.startswith("fmtorch.") and matcher.get("features") != names:
        hint = f"there is no LightGlue for {kind}" if names == "none" else f"give matcher.features={names}"
        raise ValueError(f"matcher.features={matcher.get('features')} is for other features than are computed: {hint}")
    for group in STAGES:
        if group != "pruner" and group in config:  # a training has no estimator
            files.expect_buildable(plain(config[group]), group)
    for name, value in pruner_configs(config).items():
        for where, options, _ in _versions(name, value):
            files.expect_buildable(options, where)


def compose(config_name: str, overrides: Sequence[str], config_dir: Path | None = None) -> DictConfig:
    """A command's config; a caller's own Hydra stays as it is. config_dir: of a user's presets, which are read anew."""
    words = tuple(overrides)
    return _kept(config_name, words, None) if config_dir is None else _composed(config_name, words, config_dir)


def _composed(config_name: str, overrides: tuple[str, ...], config_dir: Path | None) -> DictConfig:
    own = [] if config_dir is None else [f"hydra.searchpath=['file://{config_dir.resolve()}']"]
    with _composing:
        hydra_of_caller, GlobalHydra.instance().hydra = GlobalHydra.instance().hydra, None
        try:
            with hydra.initialize_config_dir(str(conf_dir()), version_base=None):
                return with_explicit(hydra.compose(config_name, [*own, *overrides]), overrides)
        except MissingConfigException as error:
            raise ValueError(no_preset(str(error.missing_cfg_file), error.options or ())) from None
        finally:
            GlobalHydra.instance().hydra = hydra_of_caller


_kept = functools.lru_cache(maxsize=64)(_composed)


def no_preset(file: str, options: Sequence[str]) -> str:
    """One line for a preset that there is not; options: those that Hydra found in its folder."""
    group, _, name = file.partition("/")
    if group not in files.groups():
        group, _, name = file.rpartition("/")
    there_are = nearest(name, {*(options if "/" not in name else ()), *files.available(group)})
    return f"no preset {name!r} in {group}; there are: {there_are or 'none'}"


Fields = TypeVar("Fields")


def read_fields(fields: type[Fields], config: DictConfig, where: str = "") -> Fields:
    """The fields of a dataclass from a config that may hold more.
    Raises ValueError for the first that is wrong: ``limit=-3; it must be a whole number of at least 1 or null``."""
    names = [field.name for field in dataclasses.fields(fields) if field.name in config]  # type: ignore[arg-type]
    values: dict[str, Any] = {
        name: OmegaConf.to_container(config[name], resolve=True) if OmegaConf.is_config(config[name]) else config[name]
        for name in names
    }
    paths = set(path_fields(fields))
    if empty := [name for name in values if name in paths and values[name] == ""]:
        raise ValueError(f"{empty[0]} is empty; give a path, or leave it out")
    values = {name: str(v) if name in paths and type(v) in (int, float) else v for name, v in values.items()}
    expect_options(fields, values, where)
    return _built(fields, values)


def _built(fields: type[Fields], values: Mapping[str, Any]) -> Fields:
    hints = get_type_hints(fields)
    return fields(**{name: _as(hints[name], value) for name, value in values.items()})


def _as(hint: Any, value: Any) -> Any:
    """A value of a config as its type has it: texts as paths, lists as tuples, mappings as dataclasses."""
    if isinstance(value, str) and _is_path(hint):
        return Path(value)
    if isinstance(value, list) and get_origin(hint) is tuple:
        return tuple(value)
    kind = dataclass_in(hint)
    return _built(kind, value) if isinstance(value, Mapping) and kind is not None else value


def path_fields(fields: type) -> list[str]:
    """The names of a dataclass's fields that are paths."""
    return [name for name, hint in get_type_hints(fields).items() if _is_path(hint)]


def _is_path(hint: Any) -> bool:
    return hint is Path or Path in get_args(hint)


@dataclasses.dataclass(frozen=True)
class ExecutorFields:
    """What ``conf/executor`` holds; its files say what each is."""

    name: str = "auto"
    workers: Count | None = None
    address: str | None = None
    send_images: bool = False


def execution_of(config: DictConfig, workers: int | None = None, processes: bool | None = None) -> Execution:
    """The execution that a composed config asks for. workers: in place of ``executor.workers``. processes: true or
    false in place of the executors of these kinds. Raises ValueError for what is wrong or contradicts itself."""
    options = plain(config.executor)
    fields = read_fields(ExecutorFields, config.executor, "executor")
    if workers is not None and fields.workers not in (None, workers):
        raise ValueError(f"workers={workers} and executor.workers={fields.workers} differ; give one of them")
    count = workers or fields.workers
    if "_target_" in options:
        target = {key: value for key, value in options.items() if key not in ExecutorFields.__dataclass_fields__}
        files.expect_buildable(target, "executor")
        make = functools.partial(files.instantiate, target, "executor")
        return Execution("threads", count, None, fields.send_images, cast("functools.partial[Executor]", make))
    kind = fields.name
    if processes is not None:
        wanted = "processes" if processes else "threads"
        if kind not in ("auto", wanted):
            raise ValueError(f"processes={str(processes).lower()} and executor={kind} differ; give one of them")
        kind = wanted
    return Execution(kind, count, fields.address, fields.send_images)


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
    """Have parts at any depth read their learned files, by `open_file`. Raises ValueError, naming an unusable file."""
    if hasattr(part, "open_file"):
        part.open_file(device)
    elif isinstance(part, Mapping | list | tuple):
        for each in part.values() if isinstance(part, Mapping) else part:
            open_files(each, device)
    elif type(part).__module__.partition(".")[0] == "fmtorch" and not isinstance(part, torch.nn.Module):
        open_files(list(getattr(part, "__dict__", {}).values()), device)
