"""What Hydra says of a wrong command line, in one line with the nearest names."""

from __future__ import annotations

import re

from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from fmtorch.core.options import nearest
from fmtorch.presets import available, top_level_names


def explained(error: HydraException | OmegaConfBaseException, command: str) -> str:
    """One line for an error of Hydra's composition of the config of a command."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        names = error.options or available(group)
        return f"no preset {name!r} in {group}; there are: {nearest(name, names) or 'none'}"
    if isinstance(error, OverrideParseException):
        return f"{error.override} cannot be read; a value with special characters stands in quotes: \"NAME='VALUE'\""
    cause = error
    while isinstance(cause.__cause__, HydraException | OmegaConfBaseException):
        cause = cause.__cause__
    parent = getattr(cause, "parent_node", None)
    if isinstance(cause, OmegaConfBaseException) and cause.full_key:
        names = [str(key) for key in parent] if isinstance(parent, DictConfig) else []
        if parent is not None and cause.key is not None and str(cause.key) not in names:
            names = [name for name in names if name != "hydra"]
            return f"no option {cause.full_key}; there are: {nearest(str(cause.key), names) or 'none'}"
        return f"{cause.full_key}: {_line(str(cause.msg or cause))}"
    unknown = re.search(r"[Cc]ould not override '([^']+)'", str(error))
    if isinstance(error, ConfigCompositionException) and unknown:
        return f"no option {unknown[1]}; there are: {nearest(unknown[1], top_level_names(command))}"
    return _line(str(error))


def _line(text: str) -> str:
    return " ".join(text.split())
