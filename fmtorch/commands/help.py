"""What ``--help`` prints: a command's own options with a line each, from its config, before anything of Hydra's."""

from __future__ import annotations

import re

from fmtorch.core.files import conf_dir

FOOTER = """Hydra's own: -m for sweeps (estimator=ransac,msac), --config-dir FOLDER for presets of your own, --cfg job
to print the config, --hydra-help for the rest."""
_FIELD = re.compile(r"(?P<name>[A-Za-z]\w*):(?P<value>[^#]*)(# *(?P<about>.*))?$")
_GROUP = re.compile(r" +- (?P<name>[a-z]\w*): (?P<value>[^#]*)(# *(?P<about>.*))?$")
NO_FIELDS = ("defaults", "hydra")


def help_text(command: str, positional: tuple[str, ...] = ()) -> str:
    """The page of a command: what its config's first comment says, groups, options with the first line about each."""
    lines = (conf_dir() / f"{command}.yaml").read_text(encoding="utf-8").splitlines()
    about = [line[1:].strip() for line in lines[: _first(lines)]]
    groups, fields = list[str](), list[str]()
    for line, after in zip(lines, [*lines[1:], ""], strict=True):
        more = " ..." if after.lstrip().startswith("#") else ""
        if match := _GROUP.match(line):
            groups.append(_line(match))
        elif (match := _FIELD.match(line)) and match["name"] not in NO_FIELDS:
            fields.append(_line(match) + more)
    places = "".join(f" [{name.removesuffix('...').upper()}]" for name in positional)
    parts = [
        f"usage: fmtorch {command}{places} [NAME=VALUE ...]",
        "\n".join(about),
        "\n".join(["groups of presets:", *groups]) if groups else "",
        "\n".join(["options:", *fields]),
        FOOTER,
    ]
    return "\n\n".join(filter(None, parts))


def _first(lines: list[str]) -> int:
    """The number of comment lines that a file begins with."""
    return next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))


def _line(match: re.Match[str]) -> str:
    """A name with its default and what is said of it."""
    value = match["value"].strip().replace("???", "")
    return f"  {match['name'] + '=' + value:24} {match['about'] or ''}".rstrip()
