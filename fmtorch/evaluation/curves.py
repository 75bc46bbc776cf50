"""Recall curves as SVG, within a page or a picture of their own: a style sheet colours them, for light and dark."""

from __future__ import annotations

import dataclasses
import html
import re
from collections.abc import Mapping, Sequence
from importlib import resources

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fmtorch.evaluation.statistics import THRESHOLD
from fmtorch.evaluation.summary import ALL

MAXIMUM = 0.2  # the last NSGD threshold, the paper's
MAX_CORNER_ERROR = 10.0  # px, the last of SuperGlue's and LoFTR's thresholds
COLOURS, DASHES = 7, ("", "7 4", "2 3", "9 3 2 3")  # the style sheet has classes c0 to c6; dashes repeat them
_WIDTH, _HEIGHT = 340, 250  # of a panel, in units that are CSS pixels at its usual size
_LEFT, _RIGHT, _TOP, _BOTTOM = 36, 12, 10, 38  # margins
_STEPS = 400  # of the threshold
_LINE, _LEGEND = 20, 220  # of a picture: height of a line of its legend, width of this


@dataclasses.dataclass(frozen=True)
class Axis:
    """What recall is drawn against: a column of the rows, up to a maximum, with ticks of which one is marked."""

    column: str
    maximum: float
    mark: float
    ticks: tuple[float, ...]
    label: str

    def below(self, values: NDArray[np.float64], threshold: float) -> float:
        """The share of values below a threshold; NaN is above any."""
        return float((values < threshold).mean()) if len(values) else 0.0


NSGD = Axis("nsgd", MAXIMUM, THRESHOLD, (0.0, 0.05, 0.1, 0.15, 0.2), "NSGD threshold")
CORNERS = Axis("corner_error", MAX_CORNER_ERROR, 3.0, (0.0, 1.0, 3.0, 5.0, 10.0), "corner error threshold [px]")


def axis_of(runs: Mapping[str, pa.Table]) -> Axis:
    """By corner errors where runs are of homographies, otherwise by NSGD."""
    planar = [table["corner_error"].null_count < len(table) for table in runs.values() if len(table)]
    return CORNERS if planar and all(planar) else NSGD


def panels(runs: Mapping[str, pa.Table]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Title of a panel -> name of a run -> errors of its pairs: a panel of each family, and of all of several."""
    families = by_family(runs)
    if len(families) < 2:
        return families
    column = axis_of(runs).column
    overall = {name: table[column].to_numpy().astype(np.float64) for name, table in runs.items() if len(table)}
    return {ALL: overall, **families}


def by_family(runs: Mapping[str, pa.Table]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Family -> name of a run -> errors of its pairs, of `axis_of`."""
    column = axis_of(runs).column
    out: dict[str, dict[str, NDArray[np.float64]]] = {}
    for name, table in runs.items():
        family = np.asarray(table["family"].to_pylist(), dtype=object)
        errors = table[column].to_numpy().astype(np.float64)
        for each in dict.fromkeys(family):
            out.setdefault(str(each), {})[name] = errors[family == each]
    return out


def style(number: int) -> tuple[str, str]:
    """The class that colours run `number`, and its dashes."""
    return f"c{number % COLOURS}", DASHES[number // COLOURS % len(DASHES)]


def swatch(number: int) -> str:
    """A short piece of a run's line."""
    colour, dash = style(number)
    line = f'<line x1="0" y1="4" x2="26" y2="4" stroke-dasharray="{dash}"/>'
    return f'<svg class="swatch {colour}" viewBox="0 0 26 8" aria-hidden="true">{line}</svg>'


def style_sheet() -> str:
    """The colours and lines of curves."""
    return resources.files("fmtorch.evaluation").joinpath("curves.css").read_text(encoding="utf-8")


def picture(name: str, table: pa.Table) -> str:
    """The curves of one run as an SVG file: of each family, and of all of several, with the recall at the mark."""
    axis = axis_of({name: table})
    curves = {title: errors[name] for title, errors in panels({name: table}).items()}
    rows = [f'<text x="{_WIDTH + 6}" y="{_TOP}">recall [%] at {axis.mark:g}</text>']
    for i, (title, errors) in enumerate(curves.items()):
        (colour, dash), y = style(i), _TOP + _LINE * (i + 1)
        rows.append(f'<path class="curve {colour}" stroke-dasharray="{dash}" d="M{_WIDTH + 6},{y - 4}h26"/>')
        recall = f"{100 * axis.below(errors, axis.mark):.1f}"
        rows.append(f'<text x="{_WIDTH + 38}" y="{y}">{recall} {html.escape(title)}</text>')
    height = max(_HEIGHT, _TOP + _LINE * len(curves)) + _LINE
    colours, _, rules = style_sheet().partition("@media")
    light = dict(re.findall(r"(--\w+): (#\w+)", colours))  # by their values: not every viewer knows variables
    rules = re.sub(r"var\((--\w+)\)", lambda match: light[match[1]], rules[rules.index(".c0") :])
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="plot" viewBox="0 0 {_WIDTH + _LEGEND} {height}" '
        f'font-family="sans-serif"><style>{rules}</style><rect width="100%" height="100%" fill="white"/>'
        f'<text x="{_LEFT}" y="{_LINE - 4}" font-weight="bold">{html.escape(name)}</text>'
        f'<g transform="translate(0 {_LINE})">{svg(name, curves, list(curves), axis)}{"".join(rows)}</g></svg>\n'
    )


def svg(title: str, curves: Mapping[str, NDArray[np.float64]], order: Sequence[str], axis: Axis = NSGD) -> str:
    """A panel. order: the names of all runs of the page, whose places decide the styles; the first is drawn on top."""
    parts = [
        f'<svg class="plot" viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" height="{_HEIGHT}" role="img" '
        f'aria-label="recall by {axis.label}, {html.escape(title)}">'
    ]
    for percent in range(0, 101, 20):
        y = _y(percent / 100)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{percent}</text>')
    parts += [
        f'<text x="{_x(tick / axis.maximum):.1f}" y="{_HEIGHT - 22}" text-anchor="middle">{tick:g}</text>'
        for tick in axis.ticks
    ]
    parts.append(
        f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2:.0f}" y="{_HEIGHT - 5}" text-anchor="middle">{axis.label}</text>'
    )
    x = _x(axis.mark / axis.maximum)
    parts.append(f'<line class="mark" x1="{x:.1f}" x2="{x:.1f}" y1="{_y(1.0):.1f}" y2="{_y(0.0):.1f}"/>')
    for name in reversed(list(curves)):
        colour, dash = style(order.index(name))
        quoted, line = html.escape(name, quote=True), _path(curves[name] / axis.maximum)
        parts.append(
            f'<path class="curve {colour}" data-run="{quoted}" stroke-dasharray="{dash}" d="{line}">'
            f"<title>{quoted}</title></path>"
        )
    return "".join([*parts, "</svg>"])


def _path(errors: NDArray[np.float64]) -> str:
    """The share of pairs below each threshold from 0 to 1, as a line without what lies on its straight pieces."""
    thresholds = np.linspace(0, 1, _STEPS + 1)
    share = np.searchsorted(np.sort(errors), thresholds, side="left") / max(len(errors), 1)
    change = np.diff(share) != 0
    keep = np.concatenate([[True], change]) | np.concatenate([change, [True]])
    points = [f"{_x(t):.1f},{_y(s):.1f}" for t, s in zip(thresholds[keep], share[keep], strict=True)]
    return "M" + "L".join(points)


def _x(share: float) -> float:
    return _LEFT + (_WIDTH - _LEFT - _RIGHT) * share


def _y(share: float) -> float:
    return _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * share
