"""`fmtorch list [GROUP ...]`: the presets that there are, with what each is."""

import sys

from fmtorch.core import files, terminal
from fmtorch.core.options import nearest
from fmtorch.presets.files import available, groups, summary

USAGE = """fmtorch list: the presets of all groups, or of some; those of FM-Bench's paper, paper/NAME, last

usage: fmtorch list [GROUP ...]

groups: """


HEADINGS = {"paper": "as in FM-Bench's paper"}  # of the folders within groups


def listed(group: str) -> list[str]:
    """A line for each preset, name and first sentence; its folders' under headings. Raises ValueError for no group."""
    if group not in groups():
        raise ValueError(f"no group {group!r}; there are: {nearest(group, groups())}")
    names = available(group)
    width = max(map(len, names))
    lines, folder = [], ""
    for name in names:
        if (inside := name.rpartition("/")[0]) != folder:
            folder = inside
            lines.append(f"  {HEADINGS.get(folder, folder)}:")
        lines.append(f"  {name:{width}}  {summary(files.conf_dir() / group / f'{name}.yaml')}")
    return lines


def main() -> None:
    """The command."""
    if {"--help", "-h"} & set(sys.argv[1:]):
        print(USAGE + ", ".join(groups()))
        return
    with terminal.exits_with_message():
        for group in sys.argv[1:] or groups():
            lines = listed(group)
            terminal.console.print(group, style="bold")
            for line in lines:
                terminal.console.print(line, soft_wrap=True)
