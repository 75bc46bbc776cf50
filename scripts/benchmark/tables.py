"""Tables of benchmarks, from their rows: figures and paired differences with intervals; and their curves, as SVG."""

import csv
import functools
import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import mannwhitneyu

from fmtorch.core.files import replacing
from fmtorch.evaluation import statistics
from fmtorch.evaluation.statistics import PERCENT, POSE_THRESHOLDS, Interval, areas, recalled, scene_names
from fmtorch.metrics.recall import FINE_THRESHOLD
from fmtorch.presets.composition import WIDE
from scripts.benchmark.runner import Row

BASELINES = ("wide baselines", "short baselines")
Values = NDArray[np.float64]
Names = Sequence[str]
Groups = Mapping[str, Names]  # pairs by what they have in common
Get = Callable[[str], Values]  # a field of the rows, (seeds, pairs), NaN where there is none


class Span(NamedTuple):
    value: str
    low: str
    high: str

    def __str__(self) -> str:
        return f"{self.value} [{self.low}, {self.high}]"


Record = dict[str, Any]  # a line of a table: what is printed of numbers and names, by column; empty where undefined


def span(found: Interval | None, form: str) -> Span | str:
    return "" if found is None else Span(*(f"{value:{form}}" for value in (found.value, found.low, found.high)))


class Sheet(NamedTuple):
    """A table. name: what its file's name ends in, where a command writes several; title: above it in the terminal."""

    name: str
    title: str
    records: Sequence[Record]

    @property
    def columns(self) -> list[str]:
        return list(dict.fromkeys(column for record in self.records for column in record))

    def markdown(self) -> str:
        """The table, its columns padded to one width, numbers on the right."""
        columns = []
        for head in self.columns:
            cells = [str(record.get(head, "")) for record in self.records]
            width = max(3, *map(len, (head, *cells)))
            numbers = all(re.match(r"[-+]?[\d.]", cell) for cell in cells if cell)
            columns.append([f"{cell:{'>' if numbers else '<'}{width}}" for cell in (head, "-" * width, *cells)])
        return f"{self.title}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in zip(*columns, strict=True))

    def write(self, path: Path) -> None:
        spans = {c for record in self.records for c, cell in record.items() if isinstance(cell, Span)}
        heads = {c: (c, f"{c} low", f"{c} high") if c in spans else (c,) for c in self.columns}
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, [*itertools.chain(*heads.values())], restval="", lineterminator="\n")
            writer.writeheader()
            for record in self.records:
                cells = {c: cell if isinstance(cell, Span) else (cell,) for c, cell in record.items()}
                writer.writerow({head: value for c in cells for head, value in zip(heads[c], cells[c], strict=False)})


def show(sheets: Sequence[Sheet], table: Path | None = None) -> None:
    """Print the tables that have lines; write them to `table`, of several each to a file of its own beside it."""
    for sheet in (sheet for sheet in sheets if sheet.records):
        print(sheet.markdown(), end="\n\n")
        if table is not None:
            alone = len(sheets) == 1 or not sheet.name
            sheet.write(table if alone else table.with_name(f"{table.stem}_{sheet.name}{table.suffix}"))


def grouped(rows: Iterable[Row], *fields: str) -> dict[tuple[Any, ...], list[Row]]:
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[field] for field in fields), []).append(row)
    return groups


def chance_of_more(a: Sequence[float] | Values, b: Sequence[float] | Values) -> float:
    """The area under the ROC curve: the chance that one of `a` exceeds one of `b`, ties count half; NaN of none."""
    pairs = len(a) * len(b)
    return float(mannwhitneyu(a, b, method="asymptotic").statistic) / pairs if pairs else float("nan")


def _known(values: Values) -> Values:
    """The mean of each pair over the seeds with which a figure is defined, (n,); NaN where there is none."""
    return np.asarray(np.ma.masked_invalid(values).mean(0).filled(np.nan))


def _solved(get: Get, values: Values) -> Values:
    """The same over the seeds with which a pair was solved."""
    return _known(np.where(get("ok") > 0, values, np.nan))


def _below(errors: Values, threshold: float) -> Values:
    """What each pair adds to the area under the step curve of errors up to a threshold, (n,)."""
    return np.asarray(np.clip(1 - errors / threshold, 0, 1).mean(0))


def _worst(get: Get) -> Values:
    return np.maximum(get("rotation_error"), get("translation_error"))


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
    **{f"AUC@{px} px": Figure(lambda get, px=px: _below(get("corner_error"), px), PERCENT) for px in (1, 3, 5)},  # type: ignore[misc]
    "flipped, %": Figure(lambda get: _known(get("flipped")), PERCENT),
    **{f"focal within {p} %, %": Figure(lambda get, p=p: _known(get(f"focal_{p}")), PERCENT) for p in (5, 10)},  # type: ignore[misc]
    **{f"pose@{t}": Figure(lambda get, t=t: _below(_worst(get), t), PERCENT) for t in POSE_THRESHOLDS},  # type: ignore[misc]
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

    def get(self, method: str, pairs: Sequence[str]) -> Get:
        """The fields of the method's rows of these pairs, of as many seeds as all of them have."""
        rows = [self._rows[method][pair] for pair in pairs]
        seeds = min(map(len, rows), default=0)

        def values(field: str) -> Values:
            listed = [[np.nan if (v := row.get(field)) is None else v for row in own[:seeds]] for own in rows]
            return np.array(listed, np.float64).reshape(len(rows), -1).T

        return values

    def pairs(self, *methods: str) -> list[str]:
        """The pairs that all of these methods have, or all methods where none is named."""
        return [pair for pair in self._places if all(pair in self._rows[m] for m in methods or self.methods)]

    def scenes(self, pairs: Sequence[str]) -> list[str]:
        return scene_names(*zip(*(self._places[pair] for pair in pairs), strict=True)) if pairs else []

    def by_family(self, pairs: Sequence[str]) -> dict[str, list[str]]:
        """These pairs by family, without those families that have none."""
        every = {family: [pair for pair in pairs if self._places[pair][0] == family] for family in self.families}
        return {family: own for family, own in every.items() if own}

    def by_share(self, pairs: Sequence[str], bounds: Sequence[float]) -> dict[str, list[str]]:
        """These pairs by the share of right matches, between ascending bounds; without matches it is 0."""
        right = np.nan_to_num(self.get(self.methods[0], pairs)("inlier_rate_before").mean(0))
        places, ends = np.digitize(right, bounds), [0, *bounds, 1]
        names = [f"{100 * low:g} to {100 * high:g} % right" for low, high in itertools.pairwise(ends)]
        return {name: [pair for pair, j in zip(pairs, places, strict=True) if j == i] for i, name in enumerate(names)}

    def groups(self, pairs: Sequence[str], bounds: Sequence[float] = ()) -> dict[str, list[str]]:
        """These pairs by family, of wide and of short baselines where there are both, all of several; `by_share`."""
        by_family = self.by_family(pairs)
        wide = [pair for family, own in by_family.items() if family in WIDE for pair in own]
        short = [pair for family, own in by_family.items() if family not in WIDE for pair in own]
        if wide and short:
            by_family |= dict(zip(BASELINES, (wide, short), strict=True))
        by_family |= {"all": list(pairs)} if len(by_family) > 1 else {}
        return by_family | (self.by_share(pairs, bounds) if bounds and pairs else {})

    def percent(self, method: str, pairs: Sequence[str], name: str) -> float:
        """The mean of a figure of a method over some pairs, in percent."""
        return PERCENT * float(FIGURES[name].of(self.get(method, pairs)).mean())

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
            return span(statistics.interval(values, self.scenes(pairs), figure.scale, figure.share), figure.form)
        return "" if np.isnan(values).all() else f"{figure.scale * np.nanmean(values):{figure.form}}"

    def difference(self, first: str, second: str, pairs: Sequence[str], name: str) -> Span | str:
        """A figure of one method minus that of another on the pairs that both have; empty for the same method."""
        both = [pair for pair in self.pairs(first, second) if pair in set(pairs)]
        if first == second or not both:
            return ""
        figure = FIGURES[name]
        a, b = (figure.of(self.get(method, both)) for method in (first, second))
        return span(statistics.difference(a, b, self.scenes(both), figure.scale, figure.share), "+" + figure.form)

    def records(
        self, groups: Groups, columns: Names, label: str, minus: Names = (), against: str = "", intervals: bool = False
    ) -> list[Record]:
        """A line for each group of pairs and method. label: heads the methods; minus: figures less those of `against`.
        Without `against` the first method minus each other one is shown. A method has its own pairs of each group."""
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
                both = [pair for pair in self.pairs(first, method) if pair in set(own)]
                if "time ratio" in columns and both:
                    mine, reference = (self.get(name, both)("ms").mean(0) for name in (method, first))
                    line["time ratio"] = f"{np.median(mine / reference):.2f}"
                lines.append(line)
        return lines

    def described(self, pairs: Sequence[str]) -> str:
        return statistics.described(self.scenes(pairs))

    def seeds(self, method: str) -> int:
        return min(map(len, self._rows[method].values()), default=0)


KIN = {
    "TUM": "TUM", "indoor": "TUM", "KITTI": "KITTI", "driving": "KITTI", "Strecha": "T&T", "orbit": "T&T",
    "TanksLike": "T&T", "PhotoTourism": "CPC", "collection": "CPC",
}  # fmt: skip
"""The paper's set of the same kind of camera motion; none of them is the same set."""
Published = Mapping[tuple[str, str], dict[str, str]]


@functools.cache
def published(path: Path) -> Published:
    """The figures of Bian et al. (BMVC 2019) from a CSV file, by data set and method."""
    lines = csv.DictReader(path.read_text(encoding="utf-8").splitlines())
    return {(line["dataset"], line["method"]): line for line in lines}


# Lines in panels that share a legend, as SVG without background, legible on light and dark


INK = "#808080"  # legible on white and on black
COLOURS = ("#D55E00", "#E69F00", "#009E73", "#56B4E9", "#2F8FD0", "#CC79A7", "#9A9A9A", "#B8A800")
DASHES = ("-", "-", "--", "--", "-.", "-.", ":", ":")
STYLE: Any = {
    "svg.fonttype": "none", "svg.hashsalt": "fmtorch", "font.size": 9, "font.family": "sans-serif", "text.color": INK,
    "axes.edgecolor": INK, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK,
}  # fmt: skip


class Line(NamedTuple):
    """A line through points. marked: the number of one that gets a dot."""

    x: list[float]
    y: list[float]
    marked: int | None = None


Panels = Mapping[str, Mapping[str, Line]]


def draw(
    path: Path, panels: Panels, labels: tuple[str, str], scale: str = "linear", ticks: Sequence[float] = ()
) -> None:
    """Write an SVG: a panel for each group of lines, one legend below.
    labels: of x and y. scale: of x; "shares": both axes go from 0 to 100 % and are logarithmic above a tenth of a
    percent. ticks: of x."""
    import matplotlib as mpl
    from matplotlib.figure import Figure as Canvas
    from matplotlib.ticker import FixedLocator

    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    with mpl.rc_context(STYLE), replacing(path) as temporary:
        figure = Canvas(figsize=(3.1 * len(panels) + 0.3, 3.0 + 0.16 * len(names)), layout="constrained")
        axes: Any = figure.subplots(1, len(panels), squeeze=False, sharey=scale == "shares")[0]
        for panel, (title, lines) in zip(axes, panels.items(), strict=True):
            for name, line in lines.items():
                i = names.index(name)
                style = {"color": COLOURS[i % len(COLOURS)], "zorder": 3 - i / 100}
                panel.plot(line.x, line.y, DASHES[i % len(DASHES)], linewidth=1.4 + (i == 0), label=name, **style)
                if line.marked is not None:
                    panel.plot(line.x[line.marked], line.y[line.marked], "o", markersize=5, clip_on=False, **style)
            panel.set_title(title, loc="left", fontsize=9)
            panel.set(xlabel=labels[0], facecolor="none")
            if scale == "shares":  # per cent, linear up to a tenth and logarithmic above
                panel.set(xlim=(0, 100), ylim=(0, 100))
                for axis, rescale in ((panel.xaxis, panel.set_xscale), (panel.yaxis, panel.set_yscale)):
                    rescale("symlog", linthresh=0.1, linscale=0.5)
                    axis.set_major_locator(FixedLocator((0, 0.1, 1, 10, 100)))
                    axis.set_major_formatter("{x:g}")
            else:
                panel.set_xscale(scale)
            if ticks:
                panel.set_xticks(ticks, [f"{x:g}" for x in ticks])
            panel.minorticks_off()
            panel.grid(color=INK, alpha=0.25, linewidth=0.5)
            panel.spines[["top", "right"]].set_visible(False)
        axes[0].set_ylabel(labels[1])
        labelled = (zip(*panel.get_legend_handles_labels(), strict=True) for panel in axes)
        handles = {label: handle for pairs in labelled for handle, label in pairs}
        place: dict[str, Any] = {"loc": "outside lower center", "ncols": 2, "frameon": False, "fontsize": 8}
        figure.legend([handles[name] for name in names], names, **place)
        figure.savefig(temporary, format="svg", transparent=True, metadata={"Date": None})
