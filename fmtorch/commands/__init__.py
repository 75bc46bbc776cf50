"""The commands: each reads a config and calls the rooms below. `fmtorch eval` and `python -m fmtorch.eval` are one."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.commands.config import hydra_arguments, job
    from fmtorch.commands.main import help_text
    from fmtorch.commands.options import COMMANDS, MatchOptions

__all__ = ["COMMANDS", "MatchOptions", "help_text", "hydra_arguments", "job"]

lazy_exports(__name__)
