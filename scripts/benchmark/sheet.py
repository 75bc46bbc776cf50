"""Tables that are shown in a terminal and written between the marks of a Markdown file."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from fmtorch.evaluation.statistics import Interval

MISSING = "–"
PUBLISHED = ("recall", "inlier", "inlier_m", "corrs", "corrs_m")  # columns of the paper's tables


@dataclasses.dataclass(frozen=True)
class Sheet:
    """A table with a title; the first column is text."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def terminal(self) -> Table:
        table = Table(title=self.title, title_justify="left")
        for i, column in enumerate(self.columns):
            table.add_column(column, justify="right" if i else "left")
        for row in self.rows:
            table.add_row(*row)
        return table

    def markdown(self) -> str:
        lines = [self.columns, ["---", *["---:"] * (len(self.columns) - 1)], *self.rows]
        return f"### {self.title}\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines)


def put(path: Path, sheets: Sequence[Sheet], marker: str = "figures") -> None:
    """Replace what stands between the marks of a Markdown file. Raises SystemExit for a file without them."""
    begin, end = f"<!-- {marker} -->", f"<!-- end of {marker} -->"
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    if begin not in text or end not in text:
        raise SystemExit(f"{path} must hold the lines {begin} and {end}; the tables go between them")
    before, after = text.split(begin)[0], text.split(end)[1]
    path.write_text(before + "\n\n".join([begin, *(sheet.markdown() for sheet in sheets), end]) + after, "utf-8")


def shown(interval: Interval | None, form: str) -> str:
    """``value [low, high]``, or a dash where the figure is not defined."""
    return MISSING if interval is None else f"{interval:{form}}"


Published = dict[tuple[str, str], dict[str, str]]


def published(path: Path) -> Published:
    """The figures of Bian et al. (BMVC 2019) from a CSV file, by data set and method."""
    with path.open(encoding="utf-8") as file:
        return {(line["dataset"], line["method"]): line for line in csv.DictReader(file)}


def compared(paper: Published, dataset: str, method: str) -> str:
    """The paper's figures of a method, or nothing where it has none."""
    line = paper.get((dataset, method))
    return " / ".join(line[column] for column in PUBLISHED) if line else ""
