"""Writes docs/reference/presets.md from the comments in conf/ and command_line.md from the commands' declarations.

What a page says before its first section stays.

python scripts/draw_reference.py
"""

import dataclasses
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from fmtorch.commands.list import HEADINGS
from fmtorch.commands.main import SUMMARIES
from fmtorch.commands.options import COMMANDS
from fmtorch.core.options import shown
from fmtorch.presets.files import available, summary

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "reference"

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


def text(comment: str) -> str:
    """A comment as the text of a cell of a table."""
    parts = re.split(r"(`[^`]*`)", comment.strip())
    plain = [re.sub(r"([*_<\[\]])", r"\\\1", part) if i % 2 == 0 else part for i, part in enumerate(parts)]
    return "".join(plain).replace("|", "\\|")


def rows(options: Any, prefix: str = "") -> Iterator[str]:
    """A line for each option of a dataclass of options, those of nested ones by dotted names."""
    for field in dataclasses.fields(options):
        value, name = getattr(options, field.name), f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value):
            yield from rows(value, f"{name}.")
        else:
            yield f"| `{name}` | `{shown(value)}` | {text(str(field.metadata['about']))} |"


def head(page: str) -> str:
    return (PAGES / page).read_text(encoding="utf-8").partition("\n## ")[0]


def table(columns: Sequence[str], lines: Iterable[str]) -> str:
    return "\n".join([f"| {' | '.join(columns)} |", "|" + " --- |" * len(columns), *lines]) + "\n"


def presets_page() -> str:
    parts = [head("presets.md")]
    for group, title in GROUPS.items():
        for folder, names in itertools.groupby(available(group), lambda name: name.rpartition("/")[0]):
            parts.append(f"### {group}: {HEADINGS[folder]}\n" if folder else f"## {group}\n\n{title}\n")
            files = ((name, f"conf/{group}/{name}.yaml") for name in names)
            lines = [f"| [`{name}`](../../{file}) | {text(summary(ROOT / file))} |" for name, file in files]
            parts.append(table(("name", "what it is"), lines))
    return "\n".join(parts)


def commands_page() -> str:
    parts = [head("command_line.md")]
    for name, usage in USAGES.items():
        words = SUMMARIES[name]
        about = text(words[0].upper() + words[1:])
        parts.append(f"## {name}\n\n```text\n{usage}\n```\n\n{about}.\n")
        parts.append(table(("option", "default", "what it is"), rows(COMMANDS[name].options())))
    return "\n".join(parts)


def main() -> None:
    for name, page in (("presets.md", presets_page()), ("command_line.md", commands_page())):
        (PAGES / name).write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
