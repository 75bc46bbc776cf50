"""How a command runs: Hydra composes its config, and a user's mistake ends it with one line and status 1."""

import argparse
import contextlib
import functools
import pdb
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.hydra import Hydra
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.core.utils import env_override
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import GrammarParseError, OmegaConfBaseException

from fmtorch.commands.options import COMMANDS, Command
from fmtorch.core import failures, terminal
from fmtorch.core.files import STAGES, conf_dir
from fmtorch.core.options import nearest
from fmtorch.presets import composition

Task = Callable[[DictConfig], None]
SUBMITTED = "jobs run in other processes; what each prints: .submitit/JOB/JOB_0_log.out below hydra.sweep.dir (runs)"
OVERRIDE = re.compile(r"(?P<key>(?:\+\+|\+)?[A-Za-z_][\w./@:-]*)=(?P<value>.*)", re.DOTALL)
LITERAL = re.compile(r"null|true|false|\?\?\?|'.*'|\".*\"", re.IGNORECASE | re.DOTALL)  # what a path field may hold

if sys.version_info >= (3, 14):  # where argparse formats each help, of which Hydra 1.3 has one that is no text
    argparse.ArgumentParser._check_help = lambda *_: None
for each in COMMANDS.values():
    quiet = [{f"override hydra/{part}_logging": "none"} for part in ("hydra", "job")]
    own = {"output_subdir": None, "run": {"dir": "."}, "sweep": {"dir": each.sweeps, "subdir": "."}}
    defaults = [*({group: name} for group, name in each.groups.items()), "_self_", *quiet]
    ConfigStore.instance().store(each.name, {"defaults": defaults, **each.defaults, "hydra": own})


def job(task: Task) -> Task:
    """The task, ending a single run with one line for a user's mistake; a sweep goes on with its other jobs first."""

    @functools.wraps(task)
    def wrapped(config: DictConfig) -> None:
        try:
            _expect_known(HydraConfig.get().overrides.task)
            task(composition.with_explicit(config, HydraConfig.get().overrides.task))
        except Exception as error:
            if config.get("debug") is True or config.get("debug") == "pdb":  # show all of the traceback
                traceback.print_exception(error)
                if config.debug == "pdb":
                    pdb.post_mortem(error.__traceback__)
                sys.exit(1)
            if trace := failures.own_traceback(error):
                terminal.errors.print(trace, soft_wrap=True)
            if not (trace or isinstance(error, terminal.MISTAKES)):
                raise
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise ValueError(terminal.error_line(error)) from None  # which can be sent between processes
            sys.exit(f"error: {terminal.error_line(error)}")

    return wrapped


def chosen_pipeline() -> tuple[str, list[str]]:
    """The name of the pipeline's preset that runs, and what the command line changes of its stages."""
    config = HydraConfig.get()
    changed = [word for word in config.overrides.task if word.lstrip("+~").startswith(tuple(STAGES))]
    groups = dict(word.split("=", 1) for word in changed if word.partition("=")[0] in STAGES)
    if len(groups) < len(STAGES):
        return str(config.runtime.choices["pipeline"]), changed
    names = [name for group in STAGES for name in groups[group].strip("[]").split(",")]  # nothing is the pipeline's
    return "-".join(dict.fromkeys(names)), [word for word in changed if word.partition("=")[0] not in STAGES]


def run_command(command: Command, task: Task) -> None:
    """Run a `job` on the config that a command's declaration and the command line compose.
    task: a `job` that its module holds under its own name, so that launchers can send it to other processes."""
    with terminal.exits_with_message(command.interrupted):
        paths = [*composition.path_fields(command.options), *command.texts]
        sys.argv[1:] = hydra_arguments(sys.argv[1:], paths, command.positional)
        for name, _, value in (word.partition("=") for word in sys.argv):
            if value == "null" or value.startswith("["):
                if isinstance(preset := command.groups.get(name), str):
                    raise ValueError(f"{name}={value}; it must be one preset, such as {preset}")
                if value == "null" and preset is not None:
                    raise ValueError(f"{name}=null; it must be a list of presets, [] for none")
        if any(word.startswith("hydra/launcher=submitit") for word in sys.argv):
            print(SUBMITTED, flush=True)
        if not any(word.startswith("hydra.mode=") for word in sys.argv):
            Hydra.get_mode = lambda *_, **__: None  # type: ignore[method-assign]  # it would compose the config again
        try:
            with env_override({"HYDRA_FULL_ERROR": "1"}):  # Hydra then leaves errors to us
                hydra.main(version_base=None, config_path=str(conf_dir()), config_name=command.name)(task)()
        except (HydraException, OmegaConfBaseException) as error:
            sys.exit(f"error: {explained(error, command.name)}")


def _expect_known(overrides: Sequence[str]) -> None:
    """Raise ValueError for a field that is added (`+limti=2`) and that no command takes."""
    job_config = HydraConfig.get()
    names = COMMANDS[str(job_config.job.config_name)].names
    known = {*names, *map(str, job_config.runtime.choices)}
    for word in overrides:
        name = word.lstrip("+").partition("=")[0]
        if word.startswith("+") and re.fullmatch(r"\w+", name) and name not in known:
            raise ValueError(f"no option {name}; there are: {nearest(name, names)}")


def explained(error: HydraException | OmegaConfBaseException, command: str) -> str:
    """One line for an error of Hydra's composition of the config of a command."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return composition.no_preset(str(error.missing_cfg_file), error.options or ())
    if isinstance(error, OverrideParseException):
        return f"{error.override} cannot be read; a value with special characters stands in quotes: \"NAME='VALUE'\""
    cause = error
    while isinstance(cause.__cause__, HydraException | OmegaConfBaseException):
        cause = cause.__cause__
    parent, options = getattr(cause, "parent_node", None), COMMANDS[command].names
    if isinstance(cause, GrammarParseError):
        return f"{cause.full_key}: {_line(str(cause.msg))}"
    if isinstance(cause, OmegaConfBaseException) and cause.full_key:
        values: Any = OmegaConf.to_container(parent) if isinstance(parent, DictConfig) else {}
        names = list(map(str, values))
        if parent is not None and cause.key is not None and str(cause.key) not in names:
            names += [f"{name}.{cause.key}" for name, v in values.items() if isinstance(v, dict) and cause.key in v]
            names = [n for n in names if not n.startswith(("hydra", "_"))] if "." in cause.full_key else options
            return f"no option {cause.full_key}; there are: {nearest(str(cause.key), names) or 'none'}"
        return f"{cause.full_key}: {_line(str(cause.msg or cause))}"
    unknown = re.search(r"[Cc]ould not override '([^']+)'", str(error))
    if isinstance(error, ConfigCompositionException) and unknown:
        return f"no option {unknown[1]}; there are: {nearest(unknown[1], COMMANDS[command].names)}"
    if several := re.search(r"Ambiguous value for argument '([^']+)'", str(error)):
        return f"{several[1]}: to run with each of several values, add -m"
    return _line(str(error))


def _line(text: str) -> str:
    return " ".join(text.split())


def hydra_arguments(words: Sequence[str], paths: Sequence[str], positional: Sequence[str]) -> list[str]:
    """The arguments for Hydra, of the words of a command line: its own flags first, then ``name=value``.
    paths: fields that hold a path, which may hold spaces, brackets, commas and ``=`` without further quotes.
    positional: fields that may be given by place alone; the last one takes a list if its name ends in ``...``. Raises
    ValueError for more positional arguments than there are."""
    flags, overrides = _split(words)
    multirun = any(flag in ("-m", "--multirun") for flag in flags)
    placed = [word for word in overrides if _is_positional(word)]
    named = [_quoted(word, paths, multirun) for word in overrides if not _is_positional(word)]
    return [*flags, *_named(placed, positional), *named]


def _split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The flags with their values, and all others. Raises ValueError for an option with dashes (``--limit 5``)."""
    actions = get_args_parser()._actions
    takes_value = {name for action in actions if action.nargs != 0 for name in action.option_strings}
    known = tuple(name for action in actions for name in action.option_strings)
    flags: list[str] = []
    others: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word == "--":
            return flags, others + rest
        if not word.startswith("-"):
            others.append(word)
            continue
        name, given, value = word.partition("=")
        if name in ("--config-name", "-cn", "--config-path", "-cp"):
            raise ValueError(f"{name}: each command has its own config; presets of your own: --config-dir FOLDER")
        if name not in known and not (name.startswith("--") and any(flag.startswith(name) for flag in known)):
            option = name.lstrip("-").replace("-", "_")
            value = value if given else rest[0] if rest and not rest[0].startswith("-") else "VALUE"
            raise ValueError(f"{name}: options have no dashes: {option}={value}")
        flags.append(word)
        if word in takes_value and rest and not (word in ("-i", "--info") and "=" in rest[0]):
            flags.append(rest.pop(0))
    return flags, others


def _is_positional(word: str) -> bool:
    return not word.startswith("~") and (OVERRIDE.fullmatch(word) is None or _exists(word))


def _named(placed: list[str], positional: Sequence[str]) -> Iterator[str]:
    if not placed:
        return
    names = ", ".join(name.removesuffix("...") for name in positional)
    if not positional:
        raise ValueError(f"{placed[0]} is not of the form NAME=VALUE")
    if positional[-1].endswith("..."):
        yield f"{names}=[{','.join(map(_text, placed))}]"
        return
    if len(placed) > len(positional):
        raise ValueError(f"{' '.join(placed[len(positional) :])}: only {names} may stand without NAME=")
    yield from (f"{name}={_text(value)}" for name, value in zip(positional, placed, strict=False))


def _quoted(word: str, paths: Sequence[str], multirun: bool) -> str:
    """The override with its value in quotes where that is a path, which Hydra would take apart."""
    match = OVERRIDE.fullmatch(word)
    if match is None:
        return word
    key, value = match["key"], match["value"]
    swept = multirun and ("," in value or "(" in value) and _parses(word)
    is_path = key.lstrip("+") in paths and LITERAL.fullmatch(value) is None and not swept
    is_file = _exists(value) and (set(value) & set(",[]{}()") or not _parses(word))
    return f"{key}={_text(value)}" if is_path or is_file else word


def _exists(value: str) -> bool:
    with contextlib.suppress(OSError):  # too long for a name
        return bool(value) and Path(value).exists()
    return False


def _parses(word: str) -> bool:
    with contextlib.suppress(HydraException):
        return bool(OverridesParser.create().parse_override(word))
    return False


def _text(value: str) -> str:
    return QuotedString(text=value, quote=Quote.single).with_quotes()
