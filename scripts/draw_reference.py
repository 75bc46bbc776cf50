"""Writes docs/reference/presets.md and docs/reference/command_line.md from the comments in conf/.

python scripts/draw_reference.py
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from fmtorch.commands.list import HEADINGS
from fmtorch.presets.files import available, summary

ROOT = Path(__file__).resolve().parents[1]
CONF, PAGES = ROOT / "conf", ROOT / "docs" / "reference"

GROUPS = {
    "pipeline": "Pipelines: features, matcher, pruners and estimator by one name, `pipeline=NAME`.",
    "features": "Local features, `features=NAME`.",
    "matcher": "Matchers, `matcher=NAME`.",
    "pruner": "Pruners and priors, in the order in which they are named: `'pruner=[NAME,NAME]'`.",
    "estimator": "Robust estimators, `estimator=NAME`, and `find_fundamental(x0, x1, estimator=NAME)`.",
    "dataset": "Data sets, `dataset=NAME`.",
    "executor": "Where commands run batches of pairs, `executor=NAME`.",
    "trainer": "Where `fmtorch train` runs, `trainer=NAME`.",
    "photographs": "Which photographs `fmtorch train` takes as planes, `photographs=NAME`.",
}
COMMANDS = {
    "match": "fmtorch match A.jpg B.jpg [NAME=VALUE ...]",
    "eval": "fmtorch eval [NAME=VALUE ...]",
    "report": "fmtorch report [RUN ...] [NAME=VALUE ...]",
    "pairs": "fmtorch pairs dataset=NAME output=FOLDER [NAME=VALUE ...]",
    "train": "fmtorch train pruner=NAME [NAME=VALUE ...]",
    "verify": "fmtorch verify DATABASE [NAME=VALUE ...]",
}
PRESETS_HEAD = """# Presets

Each preset is a YAML file of `conf/`, with the unit and the source of every value in its comments. A value is replaced
on the command line, `estimator.threshold=0.5`, or in Python,
`fmtorch.presets.build("estimator", "msac", threshold=0.5)`. Presets of your own stand in a folder of yours
([Your own parts](../guides/own_parts.md)). This page is written by `python scripts/draw_reference.py`.
"""
COMMANDS_HEAD = """# Command line

`fmtorch COMMAND` is the same as `python -m fmtorch.COMMAND`. Options are `NAME=VALUE`; groups, such as
`estimator=lmeds`, take a [preset](presets.md), and their values are set by path, `estimator.threshold=0.5`. `-m` runs a
sweep over values that are separated by commas; `--config-dir FOLDER` adds presets of your own. A value of `null` is
none. This page is written by `python scripts/draw_reference.py`.
"""


class Option(NamedTuple):
    name: str  # dotted
    default: str
    comment: str


def text(comment: str) -> str:
    """A comment as the text of a cell of a table."""
    parts = re.split(r"(`[^`]*`)", comment.strip())
    plain = [re.sub(r"([*_<\[\]])", r"\\\1", part) if i % 2 == 0 else part for i, part in enumerate(parts)]
    return "".join(plain).replace("|", "\\|")


def default(option: Option) -> str:
    if option.default == "???":
        return "to be given"
    return f"`{option.default}`" if option.default else ""


def sentence(words: str) -> str:
    return text(words[0].upper() + words[1:]) + "."


def options(path: Path) -> Iterator[Option]:
    """The options of a command's configuration, nested ones by dotted names; a comment goes on in lines of its own."""
    parents: list[tuple[int, str]] = []
    current: Option | None = None
    for line in path.read_text(encoding="utf-8").splitlines():
        entry = re.match(r"^( *)(\w+):(?: +([^#]*?))?(?: *#(.*))?$", line)
        if entry is None:
            more = re.match(r"^ +#(.*)$", line)
            if current is not None and more is not None:
                current = current._replace(comment=f"{current.comment} {more[1].strip()}")
            continue
        if current is not None:
            yield current
        indent, name, default, comment = len(entry[1]), entry[2], (entry[3] or "").strip(), (entry[4] or "").strip()
        parents = [*((at, key) for at, key in parents if at < indent), (indent, name)]
        current = Option(".".join(key for _, key in parents), default, comment)
    if current is not None:
        yield current


def presets_page() -> str:
    parts = [PRESETS_HEAD]
    for group, title in GROUPS.items():
        for folder, names in itertools.groupby(available(group), lambda name: name.rpartition("/")[0]):
            rows = [
                f"| [`{name}`](../../conf/{group}/{name}.yaml) | {text(summary(CONF / group / f'{name}.yaml'))} |"
                for name in names
            ]
            head = f"### {group}: {HEADINGS[folder]}\n" if folder else f"## {group}\n\n{title}\n"
            parts.append("\n".join([head, "| name | what it is |", "| --- | --- |", *rows]) + "\n")
    return "\n".join(parts)


def commands_page() -> str:
    parts = [COMMANDS_HEAD]
    for command, usage in COMMANDS.items():
        path = CONF / f"{command}.yaml"
        rows = [
            f"| `{o.name}` | {default(o)} | {text(o.comment)} |"
            for o in options(path)
            if not o.name.startswith(("defaults", "hydra")) and (o.default or o.comment)
        ]
        head = [f"## {command}\n", f"```text\n{usage}\n```\n", f"{sentence(summary(path).partition(': ')[2])}\n"]
        parts.append("\n".join([*head, "| option | default | what it is |", "| --- | --- | --- |", *rows]) + "\n")
    return "\n".join(parts)


def main() -> None:
    for name, page in (("presets.md", presets_page()), ("command_line.md", commands_page())):
        (PAGES / name).write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
