"""Curves of AUC@0.05 against time as an SVG of its own, which follows light and dark."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence

from fmtorch.evaluation.curves import style

Figures = Mapping[str, Mapping[str, Mapping[str, float]]]

_WIDTH, _HEIGHT, _LEGEND = 380, 300, 260  # of a panel, and the width of the legend, px
_LEFT, _RIGHT, _TOP, _BOTTOM = 40, 14, 28, 40  # margins of a panel
_TICKS = (1, 2, 5, 10, 20, 50, 100, 200, 500)  # ms
_COLOURS = (
    ("#0072b2", "#d55e00", "#00805d", "#b8558f", "#a87400", "#2f93c8", "#222"),  # light, as in the report
    ("#4aa8ea", "#ff8b4d", "#35c99c", "#e79cc6", "#e8b53c", "#9ad8f8", "#f2f2f2"),  # dark
)


def figure(curves: Mapping[str, Sequence[str]], figures: Figures, knees: Mapping[str, str]) -> str:
    """A panel for wide and one for short baselines, or one for all. curves: name -> estimators. knees: name -> one."""
    overall = list(figures)[-1]
    shown = [group for group in figures if group.endswith("baselines")] or [overall]
    width = _WIDTH * len(shown) + _LEGEND
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {_HEIGHT}" width="{width}" height="{_HEIGHT}" '
        'role="img" aria-label="AUC@0.05 against milliseconds a pair">',
        f"<style>{_style()}</style>",
    ]
    for i, group in enumerate(shown):
        parts.append(f'<g transform="translate({i * _WIDTH} 0)">{_panel(group, curves, figures[group], knees)}</g>')
    parts.append(f'<g transform="translate({_WIDTH * len(shown)} 0)">{_legend(list(curves))}</g></svg>')
    return "".join(parts) + "\n"


def _style() -> str:
    def colours(place: int) -> str:
        return "".join(f".c{i}{{--c:{colour}}}" for i, colour in enumerate(_COLOURS[place]))

    return (
        "svg{--ink:#1c2126;--line:#dfe3e8;--paper:#fff;font:12px system-ui,sans-serif;background:var(--paper)}"
        f"text{{fill:var(--ink)}}.grid{{stroke:var(--line)}}{colours(0)}"
        "path{fill:none;stroke:var(--c);stroke-width:1.6}circle{fill:var(--paper);stroke:var(--c);stroke-width:1.5}"
        ".knee{fill:var(--c)}"
        "@media(prefers-color-scheme:dark){svg{--ink:#e6e9ec;--line:#323a42;--paper:#14181c}" + colours(1) + "}"
    )


def _panel(
    title: str, curves: Mapping[str, Sequence[str]], points: Mapping[str, Mapping[str, float]], knees: Mapping[str, str]
) -> str:
    specs = [spec for curve in curves.values() for spec in curve]
    times, areas = [points[spec]["ms_median"] for spec in specs], [points[spec]["auc_05"] for spec in specs]
    low, high = math.log(min(times) / 1.15), math.log(max(times) * 1.15)
    step = 5 if max(areas) - min(areas) > 12 else 2 if max(areas) - min(areas) > 4 else 1
    bottom, top = step * math.floor(min(areas) / step), step * math.ceil((max(areas) + 0.01) / step)

    def x(ms: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * (math.log(ms) - low) / (high - low)

    def y(area: float) -> float:
        return _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * (area - bottom) / (top - bottom)

    parts = [f'<text x="{_LEFT}" y="16">{html.escape(title)}: AUC@0.05, %</text>']
    for value in range(bottom, top + 1, step):
        parts.append(
            f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y(value):.1f}" y2="{y(value):.1f}"/>'
        )
        parts.append(f'<text x="{_LEFT - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value}</text>')
    parts += [
        f'<text x="{x(tick):.1f}" y="{_HEIGHT - 22}" text-anchor="middle">{tick}</text>'
        for tick in _TICKS
        if low <= math.log(tick) <= high
    ]
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(f'<text x="{middle:.0f}" y="{_HEIGHT - 6}" text-anchor="middle">ms a pair (median)</text>')
    for number, (name, curve) in reversed(list(enumerate(curves.items()))):  # the first on top
        colour, dash = style(number)
        at = [(x(points[spec]["ms_median"]), y(points[spec]["auc_05"])) for spec in curve]
        line = "M" + "L".join(f"{px:.1f},{py:.1f}" for px, py in at)
        parts.append(
            f'<g class="{colour}"><title>{html.escape(name)}</title><path d="{line}" stroke-dasharray="{dash}"/>'
        )
        for spec, (px, py) in zip(curve, at, strict=True):
            kind = ' class="knee"' if knees.get(name) == spec else ""
            parts.append(f'<circle{kind} cx="{px:.1f}" cy="{py:.1f}" r="3"/>')
        parts.append("</g>")
    return "".join(parts)


def _legend(names: Sequence[str]) -> str:
    parts = []
    for number, name in enumerate(names):
        colour, dash = style(number)
        y = _TOP + 18 * number
        parts.append(f'<path class="{colour}" d="M6,{y}h24" stroke-dasharray="{dash}"/>')
        parts.append(f'<text x="36" y="{y + 4}">{html.escape(name)}</text>')
    return "".join(parts)
