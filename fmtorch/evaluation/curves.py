"""Recall curves as SVG inside a page: its style sheet colours them, so that they follow light and dark."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fmtorch.evaluation.statistics import THRESHOLD
from fmtorch.evaluation.summary import ALL

MAXIMUM = 0.2  # the last NSGD threshold, the paper's
COLOURS, DASHES = 7, ("", "7 4", "2 3", "9 3 2 3")  # the style sheet has classes c0 to c6; dashes repeat them
_WIDTH, _HEIGHT = 340, 250  # of a panel, in units that are CSS pixels at its usual size
_LEFT, _RIGHT, _TOP, _BOTTOM = 36, 12, 10, 38  # margins
_STEPS = 400  # of the threshold


def panels(runs: Mapping[str, pa.Table]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Title of a panel -> name of a run -> NSGD of its pairs: a panel of each family, and of all of several."""
    families = by_family(runs)
    if len(families) < 2:
        return families
    whole = {name: table["nsgd"].to_numpy().astype(np.float64) for name, table in runs.items() if len(table)}
    return {ALL: whole, **families}


def by_family(runs: Mapping[str, pa.Table]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Family -> name of a run -> NSGD of its pairs."""
    out: dict[str, dict[str, NDArray[np.float64]]] = {}
    for name, table in runs.items():
        family = np.asarray(table["family"].to_pylist(), dtype=object)
        nsgd = table["nsgd"].to_numpy().astype(np.float64)
        for each in dict.fromkeys(family):
            out.setdefault(str(each), {})[name] = nsgd[family == each]
    return out


def style(number: int) -> tuple[str, str]:
    """The class that colours run `number`, and its dashes."""
    return f"c{number % COLOURS}", DASHES[number // COLOURS % len(DASHES)]


def swatch(number: int) -> str:
    """A short piece of a run's line."""
    colour, dash = style(number)
    line = f'<line x1="0" y1="4" x2="26" y2="4" stroke-dasharray="{dash}"/>'
    return f'<svg class="swatch {colour}" viewBox="0 0 26 8" aria-hidden="true">{line}</svg>'


def svg(title: str, curves: Mapping[str, NDArray[np.float64]], order: Sequence[str]) -> str:
    """A panel. order: the names of all runs of the page, whose places decide the styles; the first is drawn on top."""
    parts = [
        f'<svg class="plot" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="recall by NSGD threshold, '
        f'{html.escape(title)}">'
    ]
    for percent in range(0, 101, 20):
        y = _y(percent / 100)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{percent}</text>')
    parts += [
        f'<text x="{_x(tick):.1f}" y="{_HEIGHT - 22}" text-anchor="middle">{tick:g}</text>'
        for tick in (0.0, 0.05, 0.1, 0.15, 0.2)
    ]
    parts.append(
        f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2:.0f}" y="{_HEIGHT - 5}" text-anchor="middle">NSGD threshold</text>'
    )
    parts.append(
        f'<line class="mark" x1="{_x(THRESHOLD):.1f}" x2="{_x(THRESHOLD):.1f}" y1="{_y(1.0):.1f}" y2="{_y(0.0):.1f}"/>'
    )
    for name in reversed(list(curves)):
        colour, dash = style(order.index(name))
        quoted = html.escape(name, quote=True)
        parts.append(
            f'<path class="curve {colour}" data-run="{quoted}" stroke-dasharray="{dash}" d="{_path(curves[name])}">'
            f"<title>{quoted}</title></path>"
        )
    return "".join([*parts, "</svg>"])


def _path(nsgd: NDArray[np.float64]) -> str:
    """The share of pairs below each threshold, as a line that leaves out what lies on its straight pieces."""
    thresholds = np.linspace(0, MAXIMUM, _STEPS + 1)
    share = np.searchsorted(np.sort(nsgd), thresholds, side="left") / max(len(nsgd), 1)
    change = np.diff(share) != 0
    keep = np.concatenate([[True], change]) | np.concatenate([change, [True]])
    points = [f"{_x(t):.1f},{_y(s):.1f}" for t, s in zip(thresholds[keep], share[keep], strict=True)]
    return "M" + "L".join(points)


def _x(threshold: float) -> float:
    return _LEFT + (_WIDTH - _LEFT - _RIGHT) * threshold / MAXIMUM


def _y(share: float) -> float:
    return _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * share
