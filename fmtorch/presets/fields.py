"""The options of a command, checked, from the config that Hydra composed of them."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from omegaconf import DictConfig, OmegaConf

from fmtorch.core.options import dataclass_in, expect_options

Fields = TypeVar("Fields")


def read_fields(fields: type[Fields], config: DictConfig, where: str = "") -> Fields:
    """The fields of a dataclass from a config that may hold more.

    Raises ValueError naming the first that is wrong, as ``limit=-3; it must be a whole number of at least 1 or null``.
    """
    names = [field.name for field in dataclasses.fields(fields) if field.name in config]  # type: ignore[arg-type]
    values: dict[str, Any] = {
        name: OmegaConf.to_container(config[name], resolve=True) if OmegaConf.is_config(config[name]) else config[name]
        for name in names
    }
    paths = set(path_fields(fields))
    values = {name: str(v) if name in paths and type(v) in (int, float) else v for name, v in values.items()}
    expect_options(fields, values, where)
    return _built(fields, values)


def _built(fields: type[Fields], values: Mapping[str, Any]) -> Fields:
    """The dataclass of values that fit it."""
    hints = get_type_hints(fields)
    return fields(**{name: _as(hints[name], value) for name, value in values.items()})


def _as(hint: Any, value: Any) -> Any:
    """A value of a config as its type has it: texts as paths, lists as tuples, mappings as dataclasses."""
    if isinstance(value, str) and _is_path(hint):
        return Path(value)
    if isinstance(value, list) and typing.get_origin(hint) is tuple:
        return tuple(value)
    kind = dataclass_in(hint)
    return _built(kind, value) if isinstance(value, Mapping) and kind is not None else value


def path_fields(fields: type) -> list[str]:
    """The names of a dataclass's fields that are paths."""
    return [name for name, hint in get_type_hints(fields).items() if _is_path(hint)]


def _is_path(hint: Any) -> bool:
    return hint is Path or Path in get_args(hint)
