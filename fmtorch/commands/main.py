"""How every command runs: Hydra composes its config, and a user's mistake ends it with one line and status 1."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import env_override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from fmtorch.commands.explain import explained
from fmtorch.commands.overrides import hydra_arguments
from fmtorch.core.resources import conf_dir
from fmtorch.core.terminal import MISTAKES, error_line, exits_with_message
from fmtorch.presets.pruners import with_explicit

Task = Callable[[DictConfig], None]


class Mistake(ValueError):
    """A user's mistake in one job of a sweep, error_line by its message: it can be sent between processes."""


def job(task: Task) -> Task:
    """The task, ending a single run with one line for a user's mistake; a sweep goes on with its other jobs first."""

    @functools.wraps(task)
    def wrapped(config: DictConfig) -> None:
        try:
            task(with_explicit(config, HydraConfig.get().overrides.task))
        except MISTAKES as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise Mistake(error_line(error)) from None
            sys.exit(f"error: {error_line(error)}")

    return wrapped


def run_command(
    name: str,
    task: Task,
    *,
    paths: Sequence[str] = (),
    positional: Sequence[str] = (),
    interrupted: str = "interrupted",
) -> None:
    """Run a `job` on the config that ``conf/<name>.yaml`` and the command line compose.

    Args:
        name: of the command and of its config.
        task: a `job` that its module holds under its own name, so that launchers can send it to other processes.
        paths, positional: fields that hold paths, and those that need no name, see `hydra_arguments`.
        interrupted: what is said where the user stops it.
    """
    with exits_with_message(interrupted):
        sys.argv[1:] = hydra_arguments(sys.argv[1:], paths, positional)
        try:
            with env_override({"HYDRA_FULL_ERROR": "1"}):  # Hydra then leaves errors to us
                hydra.main(version_base=None, config_path=str(conf_dir()), config_name=name)(task)()
        except (HydraException, OmegaConfBaseException) as error:
            sys.exit(f"error: {explained(error, name)}")
