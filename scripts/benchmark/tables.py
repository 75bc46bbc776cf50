"""Tables of benchmarks, from their rows: figures and paired differences with intervals; Markdown here, CSV in files."""

from __future__ import annotations

import csv
import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmtorch.evaluation.statistics import (
    PERCENT,
    POSE_THRESHOLDS,
    Interval,
    areas,
    described,
    difference,
    interval,
    recalled,
    scene_names,
)
from fmtorch.metrics.recall import FINE_THRESHOLD
from fmtorch.presets.composition import WIDE
from scripts.benchmark.runner import Row

BASELINES = ("wide baselines", "short baselines")
Values = NDArray[np.float64]
Get = Callable[[str], Values]  # a field of the rows, (seeds, pairs), NaN where there is none


@dataclasses.dataclass(frozen=True)
class Span:
    """A figure with its 95 % interval, as text."""

    value: str
    low: str
    high: str

    def __str__(self) -> str:
        return f"{self.value} [{self.low}, {self.high}]"


Record = dict[str, Any]  # a line of a table: what is printed of numbers and names, by column; empty where undefined


def span(found: Interval | None, form: str) -> Span | str:
    """An interval as a cell."""
    return "" if found is None else Span(*(f"{value:{form}}" for value in (found.value, found.low, found.high)))


@dataclasses.dataclass(frozen=True)
class Sheet:
    """A table. name: what its file's name ends in, where a command writes several; title: above it in the terminal."""

    name: str
    title: str
    records: Sequence[Record]

    @property
    def columns(self) -> list[str]:
        """The columns of all lines."""
        return list(dict.fromkeys(column for record in self.records for column in record))

    def markdown(self) -> str:
        """The table, its columns padded to one width."""
        lines = [self.columns, *([str(record.get(c, "")) for c in self.columns] for record in self.records)]
        widths = [max(3, *(len(line[i]) for line in lines)) for i in range(len(self.columns))]
        rule = ["-" * width for width in widths]
        padded = [
            [
                cell.ljust(w) if _is_text(column) else cell.rjust(w)
                for cell, w, column in zip(line, widths, zip(*lines[1:], strict=True), strict=True)
            ]
            for line in (lines[0], rule, *lines[1:])
        ]
        return f"{self.title}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in padded)

    def write(self, path: Path) -> None:
        """As CSV, one value a cell; an interval takes three columns."""
        spans = {c for record in self.records for c, cell in record.items() if isinstance(cell, Span)}
        heads = [head for c in self.columns for head in ((c, f"{c} low", f"{c} high") if c in spans else (c,))]
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, heads, restval="", lineterminator="\n")
            writer.writeheader()
            for record in self.records:
                line = {c: cell.value if isinstance(cell, Span) else cell for c, cell in record.items()}
                for c, cell in record.items():
                    line |= {f"{c} low": cell.low, f"{c} high": cell.high} if isinstance(cell, Span) else {}
                writer.writerow(line)


def _is_text(cells: Sequence[str]) -> bool:
    return not all(re.match(r"[-+]?[\d.]", cell) for cell in cells if cell)


def show(sheets: Sequence[Sheet], table: Path | None = None) -> None:
    """Print the tables; write them to `table`, of several each to a file of its own beside it."""
    for sheet in sheets:
        if not sheet.records:
            continue
        print(sheet.markdown(), end="\n\n")
        if table is not None:
            alone = len(sheets) == 1 or not sheet.name
            sheet.write(table if alone else table.with_name(f"{table.stem}_{sheet.name}{table.suffix}"))


def _known(values: Values) -> Values:
    """The mean of each pair over the seeds with which a figure is defined, (n,); NaN where there is none."""
    counts = ~np.isnan(values)
    total, number = np.where(counts, values, 0.0).sum(0), counts.sum(0)
    means: Values = np.divide(total, number, out=np.full(values.shape[1], np.nan), where=number > 0)
    return means


def _solved(get: Get, values: Values) -> Values:
    """The same over the seeds with which a pair was solved."""
    return _known(np.where(get("ok") > 0, values, np.nan))


def pose_areas(get: Get, threshold: float) -> Values:
    """What each pair adds to the area under the step curve of pose errors up to a threshold in degrees, (n,)."""
    worst = np.maximum(get("rotation_error"), get("translation_error"))
    share: Values = np.clip(1 - worst / threshold, 0, 1).mean(0)
    return share


class Figure(NamedTuple):
    """A column. of: what each pair adds to it, (n,), NaN where it is not defined; share: of pairs that succeed."""

    of: Callable[[Get], Values]
    scale: float = 1.0
    form: str = ".1f"
    share: bool = False


FIGURES: dict[str, Figure] = {
    **dict.fromkeys(("R.05", "%Recall"), Figure(lambda get: recalled(get("nsgd")), PERCENT, share=True)),
    "R.01": Figure(lambda get: recalled(get("nsgd"), FINE_THRESHOLD), PERCENT, share=True),
    "AUC@0.05": Figure(lambda get: areas(get("nsgd")), PERCENT),
    "%Inlier": Figure(lambda get: _solved(get, get("inlier_rate")), PERCENT),
    "%Inlier-m": Figure(lambda get: _solved(get, get("inlier_rate_before")), PERCENT),
    "#Corrs": Figure(lambda get: _solved(get, get("corrs")), form=".0f"),
    "#Corrs-m": Figure(lambda get: _solved(get, get("corrs_before")), form=".0f"),
    "kept, %": Figure(lambda get: _solved(get, get("corrs") / get("corrs_before").clip(1)), PERCENT, ".0f"),
    "keypoints": Figure(lambda get: (get("features0") + get("features1")).mean(0) / 2, form=".0f"),
    "distance, px": Figure(lambda get: _known(get("distance")), form=".3f"),
    **{
        f"AUC@{px} px": Figure(lambda get, px=px: np.clip(1 - get("corner_error") / px, 0, 1).mean(0), PERCENT)  # type: ignore[misc]
        for px in (1, 3, 5)
    },
    "flipped, %": Figure(lambda get: _known(get("flipped")), PERCENT),
    **{f"focal within {p} %, %": Figure(lambda get, p=p: _known(get(f"focal_{p}")), PERCENT) for p in (5, 10)},  # type: ignore[misc]
    **{f"pose@{t}": Figure(lambda get, t=t: pose_areas(get, t), PERCENT) for t in POSE_THRESHOLDS},  # type: ignore[misc]
}
MEDIANS = {"ms": "ms", "ms of pruners": "ms_pruning"}
"""Columns that are medians over pairs and seeds, without intervals, and their fields."""


class Results:
    """Rows by method, pair and seed; of equals the last counts. The first method is what others are compared with."""

    def __init__(self, rows: Iterable[Row]) -> None:
        by_place = {(row["method"], row["pair"], row["seed"]): row for row in rows}
        self.methods = list(dict.fromkeys(method for method, *_ in by_place))
        self._rows: dict[str, dict[str, list[Row]]] = {name: {} for name in self.methods}
        for (method, pair, _), row in by_place.items():
            self._rows[method].setdefault(pair, []).append(row)
        self._places = {pair: (row["family"], row["scene"]) for (_, pair, _), row in by_place.items()}
        self.all_pairs = list(self._places)
        self.families = sorted({family for family, _ in self._places.values()}, key=lambda f: (f not in WIDE, f))

    def of(self, method: str, pairs: Sequence[str]) -> list[list[Row]]:
        """The rows of some pairs, one list a pair; as many seeds as all of them have."""
        own = [self._rows[method][pair] for pair in pairs]
        seeds = min((len(rows) for rows in own), default=0)
        return [rows[:seeds] for rows in own]

    def get(self, method: str, pairs: Sequence[str]) -> Get:
        """The fields of the method's rows of these pairs."""
        rows = self.of(method, pairs)

        def values(field: str) -> Values:
            listed = [[np.nan if (v := row.get(field)) is None else v for row in of_pair] for of_pair in rows]
            return np.array(listed, np.float64).reshape(len(rows), -1).T

        return values

    def pairs(self, *methods: str) -> list[str]:
        """The pairs that all of these methods have, or all methods where none is named."""
        return [pair for pair in self._places if all(pair in self._rows[m] for m in methods or self.methods)]

    def scenes(self, pairs: Sequence[str]) -> list[str]:
        """The scene of each pair, with its family."""
        return scene_names(*zip(*(self._places[pair] for pair in pairs), strict=True)) if pairs else []

    def groups(self, pairs: Sequence[str]) -> dict[str, list[str]]:
        """These pairs by family, then those of wide and of short baselines where there are both, and all of several."""
        by_family = {f: [pair for pair in pairs if self._places[pair][0] == f] for f in self.families}
        by_family = {family: own for family, own in by_family.items() if own}
        wide = [pair for family, own in by_family.items() if family in WIDE for pair in own]
        short = [pair for family, own in by_family.items() if family not in WIDE for pair in own]
        if wide and short:
            by_family |= dict(zip(BASELINES, (wide, short), strict=True))
        return by_family | ({"all": list(pairs)} if len(by_family) > 1 else {})

    def cell(self, method: str, pairs: Sequence[str], name: str, intervals: bool = False) -> Span | str:
        """One figure of a method over some pairs, with its interval if asked."""
        if not pairs:
            return ""
        get = self.get(method, pairs)
        if name in MEDIANS:
            return f"{np.median(get(MEDIANS[name])):.1f}"
        if name == "failed":
            return f"{(1 - get('ok').mean(0)).sum():.1f}"
        figure = FIGURES[name]
        values = figure.of(get)
        if intervals:
            return span(interval(values, self.scenes(pairs), figure.scale, figure.share), figure.form)
        return "" if np.isnan(values).all() else f"{figure.scale * np.nanmean(values):{figure.form}}"

    def difference(self, first: str, second: str, pairs: Sequence[str], name: str) -> Span | str:
        """A figure of one method minus that of another on the pairs that both have; empty for the same method."""
        both = [pair for pair in self.pairs(first, second) if pair in set(pairs)]
        if first == second or not both:
            return ""
        figure = FIGURES[name]
        a, b = (figure.of(self.get(method, both)) for method in (first, second))
        return span(difference(a, b, self.scenes(both), figure.scale, figure.share), "+" + figure.form)

    def time_ratio(self, method: str, first: str, pairs: Sequence[str]) -> str:
        """Median over pairs of a method's time relative to the first's."""
        both = [pair for pair in self.pairs(first, method) if pair in set(pairs)]
        own, reference = (self.get(name, both)("ms").mean(0) for name in (method, first))
        return f"{np.median(own / reference):.2f}" if both else ""

    def records(
        self,
        groups: Mapping[str, Sequence[str]],
        columns: Sequence[str],
        *,
        label: str,
        intervals: bool = False,
        minus: Sequence[str] = (),
        against: str | None = None,
    ) -> list[Record]:
        """A line for each group of pairs and method. label: heads the methods; minus: figures less those of `against`.

        Without `against` the first method minus each other one is shown. A method has its own pairs of each group.
        """
        lines = []
        for group, every in groups.items():
            for method in self.methods:
                own = [pair for pair in self.pairs(method) if pair in set(every)]
                if not own:
                    continue
                line: Record = {"set": group, "pairs": len(own), label: method}
                line |= {name: self.cell(method, own, name, intervals) for name in columns if name != "time ratio"}
                first = against or self.methods[0]
                for name in minus:
                    a, b = (method, first) if against else (first, method)
                    head = f"{name} minus {against}" if against else f"lead {name}"
                    line[head] = self.difference(a, b, own, name) if first in self.methods else ""
                if "time ratio" in columns:
                    line["time ratio"] = self.time_ratio(method, first, own)
                lines.append(line)
        return lines

    def described(self, pairs: Sequence[str]) -> str:
        """How many pairs and scenes there are, and what intervals resample."""
        return described(self.scenes(pairs))

    def seeds(self, method: str) -> int:
        """How many seeds a method was measured with."""
        return min((len(rows) for rows in self._rows[method].values()), default=0)


KIN = {
    "TUM": "TUM", "indoor": "TUM", "KITTI": "KITTI", "driving": "KITTI", "Strecha": "T&T", "orbit": "T&T",
    "TanksLike": "T&T", "PhotoTourism": "CPC", "collection": "CPC",
}  # fmt: skip
"""The paper's set of the same kind of camera motion; none of them is the same set."""
PUBLISHED = ("recall", "inlier", "inlier_m", "corrs", "corrs_m")  # columns of the paper's tables
Published = Mapping[tuple[str, str], dict[str, str]]


def published(path: Path | None) -> Published:
    """The figures of Bian et al. (BMVC 2019) from a CSV file, by data set and method."""
    if path is None:
        return {}
    with path.open(encoding="utf-8") as file:
        return {(line["dataset"], line["method"]): line for line in csv.DictReader(file)}
