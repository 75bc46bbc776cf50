"""Writes docs/reference/presets.md from the comments in conf/ and command_line.md from the commands' declarations.

What a page says before its first section, and a section's heading and first paragraph, stay.
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


def text(comment: str) -> str:
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


def kept(page: str) -> tuple[str, list[list[str]]]:
    """What a page says before its first section, and of each section heading and first paragraph."""
    head, *sections = (PAGES / page).read_text(encoding="utf-8").split("\n## ")
    return head, [section.split("\n\n")[:2] for section in sections]


def table(columns: Sequence[str], lines: Iterable[str]) -> str:
    return "\n".join([f"| {' | '.join(columns)} |", "|" + " --- |" * len(columns), *lines]) + "\n"


def presets_page() -> str:
    head, sections = kept("presets.md")
    parts = [head]
    for group, title in sections:
        for folder, names in itertools.groupby(available(group), lambda name: name.rpartition("/")[0]):
            parts.append(f"### {group}: {HEADINGS[folder]}\n" if folder else f"## {group}\n\n{title}\n")
            files = ((name, f"conf/{group}/{name}.yaml") for name in names)
            lines = [f"| [`{name}`](../../{file}) | {text(summary(ROOT / file))} |" for name, file in files]
            parts.append(table(("name", "what it is"), lines))
    return "\n".join(parts)


def commands_page() -> str:
    head, sections = kept("command_line.md")
    parts = [head]
    for name, usage in sections:
        words = SUMMARIES[name]
        parts.append(f"## {name}\n\n{usage}\n\n{text(words[0].upper() + words[1:])}.\n")
        parts.append(table(("option", "default", "what it is"), rows(COMMANDS[name].options())))
    return "\n".join(parts)


def main() -> None:
    for name, page in (("presets.md", presets_page()), ("command_line.md", commands_page())):
        (PAGES / name).write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
