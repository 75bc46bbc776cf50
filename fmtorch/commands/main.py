"""The commands by one name: ``fmtorch eval pipeline=sift_ratio``, also ``python -m fmtorch eval ...``.

Help, and a mistake in the command's name, are answered here, before any library is imported."""

import dataclasses
import os
import re
import sys
import textwrap
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from fmtorch.core.version import __version__

if TYPE_CHECKING:
    from fmtorch.commands.options import Command

SUMMARIES = {
    "eval": "run a pipeline over a data set of image pairs and evaluate it",
    "list": "the presets there are, of all groups or of one: fmtorch list estimator",
    "match": "the fundamental matrix of two photographs, with pictures: fmtorch match a.jpg b.jpg",
    "pairs": "which pairs of images with known cameras can be matched, as a data set",
    "report": "compare runs of eval on one HTML page",
    "train": "train a learned pruner on labelled matches of a data set",
    "verify": "two-view geometries of the matches in a COLMAP database, or hloc's files",
    "warm-up": "compile all kernels now, for images and containers",
}
HELP = f"""fmtorch {__version__}: two-view geometry

usage: fmtorch COMMAND [NAME=VALUE ...]

{chr(10).join(f"  {name:9}{what}" for name, what in SUMMARIES.items())}

`fmtorch COMMAND --help` lists what a command takes; `python -m fmtorch COMMAND` is the same command."""
FOOTER = """Hydra's own: -m for sweeps (estimator=ransac,msac), --config-dir FOLDER for presets of your own, --cfg job
to print the config, --hydra-help for the rest."""
_COLUMN, _WIDTH = 27, 120  # where what is said of an option begins, and where its lines end


def main(words: Sequence[str] | None = None) -> None:
    """Run the command that the first word names, of the process's own command line if none are given."""
    name, *rest = (sys.argv[1:] if words is None else words) or ["--help"]
    own_help = name in ("list", "warm-up")
    if name in ("--help", "-h", "help"):
        print(HELP)
    elif name == "--version" or ("--version" in rest and not own_help):
        print(__version__)
    elif name not in SUMMARIES:
        from fmtorch.core.options import nearest

        sys.exit(f"error: no command {name!r}; there are: {nearest(name, SUMMARIES)}")
    elif {"--help", "-h"} & set(rest) and not own_help:
        from fmtorch.commands.options import COMMANDS

        print(help_text(COMMANDS[name]))
    else:
        sys.argv[1:] = rest
        if sys.path[0] != os.getcwd():  # where a user's own parts are found, as by `python -m`
            sys.path.insert(0, os.getcwd())
        try:
            _command(name)()
        except KeyboardInterrupt:  # while it is imported
            print("interrupted", file=sys.stderr)
            sys.exit(130)


def _command(name: str) -> Callable[[], None]:
    if name == "eval":
        from fmtorch.commands.eval import main
    elif name == "list":
        from fmtorch.commands.list import main
    elif name == "match":
        from fmtorch.commands.match import main
    elif name == "pairs":
        from fmtorch.commands.pairs import main
    elif name == "report":
        from fmtorch.commands.report import main
    elif name == "train":
        from fmtorch.commands.train import main
    elif name == "verify":
        from fmtorch.commands.verify import main
    else:
        from fmtorch.commands.warm_up import main
    return main


def help_text(command: "Command") -> str:
    """The page of a command: what it does, its groups of presets and its options, each with its default."""
    places = "".join(f" [{name.removesuffix('...').upper()}]" for name in command.positional)
    summary = SUMMARIES[command.name]
    about = f"{summary[0].upper()}{summary[1:]}.\n{command.about}"
    presets = {**command.groups, **_replaced(str(command.groups.get("pipeline", "")))}
    groups = [_line(name, value, command.group_help.get(name, "")) for name, value in presets.items()]
    fields, defaults = dataclasses.fields(command.options), command.defaults
    options = [_line(field.name, defaults[field.name], str(field.metadata["about"])) for field in fields]
    usage = f"usage: fmtorch {command.name}{places} [NAME=VALUE ...]"
    lists = [["groups of presets:", *groups] if groups else [], ["options:", *options]]
    return "\n\n".join(filter(None, [usage, about, *map("\n".join, lists), FOOTER]))


def _replaced(pipeline: str) -> dict[str, str]:
    """The presets that a pipeline's file puts in place of those of each stage; of no name nothing."""
    from fmtorch.core.files import conf_dir

    if not pipeline:
        return {}
    text = (conf_dir() / "pipeline" / f"{pipeline}.yaml").read_text(encoding="utf-8")
    return dict(re.findall(r"override /(\w+): (.+)", text))


def _line(name: str, value: Any, about: str) -> str:
    """A name with its default and what is said of it; of an option with parts, their names."""
    from fmtorch.core.options import shown

    if isinstance(value, dict):
        name, value, about = f"{name}.NAME", "", f"{about}; NAME: {', '.join(value)}"
    start = f"  {name}={shown(value) if value != '' else ''}"
    indented = f"\n{' ' * _COLUMN}".join(textwrap.wrap(about, _WIDTH - _COLUMN, break_on_hyphens=False) or [""])
    return f"{start:{_COLUMN - 1}} {indented}".rstrip()
