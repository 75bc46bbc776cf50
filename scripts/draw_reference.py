"""Writes docs/reference/presets.md from the comments in conf/ and command_line.md from the commands' declarations.

python scripts/draw_reference.py
"""

import dataclasses
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fmtorch.commands.list import HEADINGS
from fmtorch.commands.main import SUMMARIES
from fmtorch.commands.options import COMMANDS
from fmtorch.core.options import shown
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
USAGES = {
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

`fmtorch COMMAND` is the same as `python -m fmtorch COMMAND`. Options are `NAME=VALUE`; groups, such as
`estimator=lmeds`, take a [preset](presets.md), and their values are set by path, `estimator.threshold=0.5`. `-m` runs a
sweep over values that are separated by commas; `--config-dir FOLDER` adds presets of your own. A value of `null` is
none. This page is written by `python scripts/draw_reference.py`.
"""


def text(comment: str) -> str:
    """A comment as the text of a cell of a table."""
    parts = re.split(r"(`[^`]*`)", comment.strip())
    plain = [re.sub(r"([*_<\[\]])", r"\\\1", part) if i % 2 == 0 else part for i, part in enumerate(parts)]
    return "".join(plain).replace("|", "\\|")


def sentence(words: str) -> str:
    return text(words[0].upper() + words[1:]) + "."


def rows(options: Any, prefix: str = "") -> Iterator[str]:
    """A line for each option of a dataclass of options, those of nested ones by dotted names."""
    for field in dataclasses.fields(options):
        value, name = getattr(options, field.name), f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value):
            yield from rows(value, f"{name}.")
        else:
            yield f"| `{name}` | `{shown(value)}` | {text(str(field.metadata['about']))} |"


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
    for name, usage in USAGES.items():
        head = f"## {name}\n\n```text\n{usage}\n```\n\n{sentence(SUMMARIES[name])}\n"
        table = ["| option | default | what it is |", "| --- | --- | --- |", *rows(COMMANDS[name].options())]
        parts.append("\n".join([head, *table]) + "\n")
    return "\n".join(parts)


def main() -> None:
    for name, page in (("presets.md", presets_page()), ("command_line.md", commands_page())):
        (PAGES / name).write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
