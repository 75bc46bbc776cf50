"""How every command runs: Hydra composes its config, and a user's mistake ends it with one line and status 1."""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Callable, Sequence

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import env_override
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import GrammarParseError, OmegaConfBaseException

from fmtorch.commands.help import help_text
from fmtorch.commands.overrides import hydra_arguments
from fmtorch.core.files import conf_dir
from fmtorch.core.options import nearest
from fmtorch.core.terminal import MISTAKES, error_line, exits_with_message
from fmtorch.core.version import __version__
from fmtorch.presets import available, top_level_names
from fmtorch.presets.files import groups
from fmtorch.presets.pruners import with_explicit

Task = Callable[[DictConfig], None]
SUBMITTED = "jobs run in other processes; what each prints: .submitit/JOB/JOB_0_log.out below hydra.sweep.dir (runs)"


class Mistake(ValueError):
    """A user's mistake in one job of a sweep, error_line by its message: it can be sent between processes."""


def job(task: Task) -> Task:
    """The task, ending a single run with one line for a user's mistake; a sweep goes on with its other jobs first."""

    @functools.wraps(task)
    def wrapped(config: DictConfig) -> None:
        try:
            _expect_known(HydraConfig.get().overrides.task)
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
    if {"--version"} & set(sys.argv[1:]):
        print(__version__)
        return
    if {"--help", "-h"} & set(sys.argv[1:]):
        print(help_text(name, tuple(positional)))
        return
    with exits_with_message(interrupted):
        sys.argv[1:] = hydra_arguments(sys.argv[1:], paths, positional)
        if any(word.startswith("hydra/launcher=submitit") for word in sys.argv):
            print(SUBMITTED, flush=True)
        try:
            with env_override({"HYDRA_FULL_ERROR": "1"}):  # Hydra then leaves errors to us
                hydra.main(version_base=None, config_path=str(conf_dir()), config_name=name)(task)()
        except (HydraException, OmegaConfBaseException) as error:
            sys.exit(f"error: {explained(error, name)}")


def _expect_known(overrides: Sequence[str]) -> None:
    """Raise ValueError for a field that is added (`+limti=2`) and that no command takes."""
    job_config = HydraConfig.get()
    known = [*top_level_names(str(job_config.job.config_name)), *map(str, job_config.runtime.choices)]
    for word in overrides:
        name = word.lstrip("+").partition("=")[0]
        if word.startswith("+") and re.fullmatch(r"\w+", name) and name not in known:
            raise ValueError(f"no option {name}; there are: {nearest(name, known[: -len(job_config.runtime.choices)])}")


def explained(error: HydraException | OmegaConfBaseException, command: str) -> str:
    """One line for an error of Hydra's composition of the config of a command."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return _missing(str(error.missing_cfg_file), error.options or ())
    if isinstance(error, OverrideParseException):
        return f"{error.override} cannot be read; a value with special characters stands in quotes: \"NAME='VALUE'\""
    cause = error
    while isinstance(cause.__cause__, HydraException | OmegaConfBaseException):
        cause = cause.__cause__
    parent = getattr(cause, "parent_node", None)
    if isinstance(cause, GrammarParseError):
        return f"{cause.full_key}: {_line(str(cause.msg))}"
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


def _missing(file: str, options: Sequence[str]) -> str:
    """One line for a preset that there is not; options: those that Hydra found in its folder."""
    group, _, name = file.partition("/")
    if group not in groups():
        group, _, name = file.rpartition("/")
    there_are = nearest(name, {*(options if "/" not in name else ()), *available(group)})
    return f"no preset {name!r} in {group}; there are: {there_are or 'none'}"


def _line(text: str) -> str:
    return " ".join(text.split())
