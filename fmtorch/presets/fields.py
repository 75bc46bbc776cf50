"""The types of the commands' own fields; `read_fields` checks a composed config against them."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

from omegaconf import DictConfig, OmegaConf

from fmtorch.core.options import Within, dataclass_in, expect_options


class DeviceName:
    """A rule for texts: what `torch.device` takes, and ``auto``."""

    def __call__(self, value: str) -> bool:
        """Whether it is the name of a device."""
        return re.fullmatch(r"auto|cpu|mps|(cuda|xpu)(:\d+)?", value) is not None

    def __str__(self) -> str:
        return "that names a device: auto, cpu, cuda, cuda:1 or mps"


Count = Annotated[int, Within(1)]
Seed = Annotated[int, Within(-(2**63), 2**63 - 1)]
Device = Annotated[str, DeviceName()]
Cache = Path | bool | None  # false is off
Gigabytes = Annotated[int | float, Within(0)]
Fields = TypeVar("Fields")


def read_fields(fields: type[Fields], config: DictConfig, where: str = "") -> Fields:
    """The fields of a dataclass from a config that may hold more.

    Raises ValueError naming the first that is wrong, as ``limit=-3; it must be a whole number of at least 1 or null``.
    """
    names = [field.name for field in dataclasses.fields(fields) if field.name in config]  # type: ignore[arg-type]
    values: dict[str, Any] = {
        name: OmegaConf.to_container(config[name], resolve=True) if OmegaConf.is_config(config[name]) else config[name]
        for name in names
        if not OmegaConf.is_missing(config, name)
    }
    paths = set(path_fields(fields))
    values = {name: str(v) if name in paths and type(v) in (int, float) else v for name, v in values.items()}
    expect_options(fields, values, where)
    nested = {name: dataclass_in(hint) for name, hint in get_type_hints(fields).items()}
    values = {
        name: kind(**v) if isinstance(v, dict) and (kind := nested[name]) is not None else v
        for name, v in values.items()
    }
    return fields(**{name: Path(v) if name in paths and isinstance(v, str) else v for name, v in values.items()})


def path_fields(fields: type) -> list[str]:
    """The names of a dataclass's fields that are paths."""
    return [name for name, hint in get_type_hints(fields).items() if hint is Path or Path in get_args(hint)]
