"""Pictures as SVG: recall curves, within a page or of their own, and view graphs."""

import dataclasses
import html
import math
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import resources

import cv2
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fmtorch.evaluation.statistics import ALL, THRESHOLD
from fmtorch.io.export import Edge, ViewGraph
from fmtorch.pipeline.pictures import jpeg_url

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

    def recall(self, values: NDArray[np.float64]) -> float:
        """The share of values below the mark; NaN is above it."""
        return float((values < self.mark).mean()) if len(values) else 0.0


NSGD = Axis("nsgd", MAXIMUM, THRESHOLD, (0.0, 0.05, 0.1, 0.15, 0.2), "NSGD threshold")
CORNERS = Axis("corner_error", MAX_CORNER_ERROR, 3.0, (0.0, 1.0, 3.0, 5.0, 10.0), "corner error threshold [px]")


def axis_of(runs: Mapping[str, pa.Table]) -> Axis:
    """By corner errors where runs are of homographies, otherwise by NSGD."""
    planar = [table["corner_error"].null_count < len(table) for table in runs.values() if len(table)]
    return CORNERS if planar and all(planar) else NSGD


def panels(runs: Mapping[str, pa.Table]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Title of a panel -> name of a run -> errors of its pairs: a panel of each family, and of all of several."""
    column = axis_of(runs).column
    overall = {name: table[column].to_numpy().astype(np.float64) for name, table in runs.items() if len(table)}
    families: dict[str, dict[str, NDArray[np.float64]]] = {}
    for name, errors in overall.items():
        family = np.asarray(runs[name]["family"].to_pylist(), dtype=object)
        for each in dict.fromkeys(family):
            families.setdefault(str(each), {})[name] = errors[family == each]
    return families if len(families) < 2 else {ALL: overall, **families}


def style(number: int) -> tuple[str, str]:
    """The class that colours run `number`, and its dashes."""
    return f"c{number % COLOURS}", DASHES[number // COLOURS % len(DASHES)]


def resource(name: str) -> str:
    """The text of a file beside this one."""
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def picture(name: str, table: pa.Table) -> str:
    """The curves of one run as an SVG file: of each family, and of all of several, with the recall at the mark."""
    axis = axis_of({name: table})
    curves = {title: errors[name] for title, errors in panels({name: table}).items()}
    rows = [f'<text x="{_WIDTH + 6}" y="{_TOP}">recall [%] at {axis.mark:g}</text>']
    for i, (title, errors) in enumerate(curves.items()):
        (colour, dash), y = style(i), _TOP + _LINE * (i + 1)
        rows.append(f'<path class="curve {colour}" stroke-dasharray="{dash}" d="M{_WIDTH + 6},{y - 4}h26"/>')
        recall = f"{100 * axis.recall(errors):.1f} {html.escape(title)}"
        rows.append(f'<text x="{_WIDTH + 38}" y="{y}">{recall}</text>')
    height = max(_HEIGHT, _TOP + _LINE * len(curves)) + _LINE
    colours, _, rules = resource("curves.css").partition("@media")
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
    middle = 'text-anchor="middle"'
    parts += [f'<text x="{_x(t / axis.maximum):.1f}" y="{_HEIGHT - 22}" {middle}>{t:g}</text>' for t in axis.ticks]
    parts.append(f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2:.0f}" y="{_HEIGHT - 5}" {middle}>{axis.label}</text>')
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
    return "M" + "L".join([f"{_x(t):.1f},{_y(s):.1f}" for t, s in zip(thresholds[keep], share[keep], strict=True)])


def _x(share: float) -> float:
    return _LEFT + (_WIDTH - _LEFT - _RIGHT) * share


def _y(share: float) -> float:
    return _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * share


MAX_THUMBNAILS, MAX_LABELS, MAX_EDGES, MAX_SPECTRAL = 40, 80, 20_000, 1_500
_SIZE, _THUMBNAIL, _QUALITY = 900, 72, 80  # of the picture and a thumbnail's longer side, in CSS pixels; of JPEG
_COLOURS = ("#4269d0", "#efb118", "#ff725c", "#6cc5b0", "#3ca951", "#ff8ab7", "#a463f2", "#97bbf5")

Image = NDArray[np.uint8]


def view_graph_svg(graph: ViewGraph, read: Callable[[str], Image | None]) -> str:
    """The picture. read: the pixels of an image by its name, or None; called where there are few enough to be shown."""
    order = [name for part in graph.components() for name in spectral_order(part, graph.edges)]
    center, radius = _SIZE / 2, _SIZE / 2 - 1.4 * _THUMBNAIL
    angles = {name: 2 * math.pi * i / len(order) - math.pi / 2 for i, name in enumerate(order)}
    place = {name: (center + radius * math.cos(a), center + radius * math.sin(a)) for name, a in angles.items()}
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_SIZE} {_SIZE}" font-family="sans-serif" '
        f'font-size="11"><rect width="{_SIZE}" height="{_SIZE}" fill="white"/>'
    ]
    parts += _lines(graph.edges, place)
    component = {name: i for i, part in enumerate(graph.components()) for name in part}
    for name in order:
        picture = read(name) if len(order) <= MAX_THUMBNAILS else None
        parts.append(_node(name, place[name], _COLOURS[component[name] % len(_COLOURS)], picture))
        if len(order) <= MAX_LABELS and picture is None:
            parts.append(_label(name, angles[name], center, radius))
    return "\n".join([*parts, "</svg>\n"])


def spectral_order(names: Sequence[str], edges: Sequence[Edge]) -> list[str]:
    """Connected images in the order of the Fiedler vector: the second eigenvector of the Laplacian (Fiedler, 1973).
    Pairs weigh as the logarithm of one more than their inliers. More images than MAX_SPECTRAL stay as they are."""
    if not 3 <= len(names) <= MAX_SPECTRAL:
        return list(names)
    number = {name: i for i, name in enumerate(names)}
    weight = np.zeros((len(names), len(names)))
    for edge in edges:
        if edge.related and edge.image0 in number and edge.image1 in number:
            i, j = number[edge.image0], number[edge.image1]
            weight[i, j] = weight[j, i] = math.log1p(edge.inliers)
    _, vectors = np.linalg.eigh(np.diag(weight.sum(1)) - weight)
    value = vectors[:, 1].round(9)
    value = value if value[np.abs(value).argmax()] <= 0 else -value
    return [names[i] for i in np.argsort(value, kind="stable")]


def _lines(edges: Sequence[Edge], place: Mapping[str, tuple[float, float]]) -> list[str]:
    """A line for each related pair, as wide as the square root of its inliers says; the strongest ones on top."""
    related = sorted((edge for edge in edges if edge.related), key=lambda edge: edge.inliers)[-MAX_EDGES:]
    most = max((edge.inliers for edge in related), default=1) or 1
    lines = []
    for edge in related:
        (x0, y0), (x1, y1) = place[edge.image0], place[edge.image1]
        share = math.sqrt(edge.inliers / most)
        said = html.escape(f"{edge.image0}, {edge.image1}: {edge.inliers} inliers of {edge.matches} matches")
        lines.append(
            f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="#555" '
            f'stroke-width="{0.4 + 4 * share:.2f}" stroke-opacity="{0.2 + 0.5 * share:.2f}">'
            f"<title>{said}</title></line>"
        )
    return lines


def _node(name: str, at: tuple[float, float], colour: str, picture: Image | None) -> str:
    x, y = at
    title = f"<title>{html.escape(name)}</title>"
    if picture is None:
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}">{title}</circle>'
    scale = _THUMBNAIL / max(picture.shape[:2])
    h, w = (max(round(side * scale), 1) for side in picture.shape[:2])
    url = jpeg_url(np.asarray(cv2.resize(picture, (2 * w, 2 * h), interpolation=cv2.INTER_AREA), np.uint8), _QUALITY)
    box = f'x="{x - w / 2:.1f}" y="{y - h / 2:.1f}" width="{w}" height="{h}"'
    return f'<g><image {box} href="{url}"/><rect {box} fill="none" stroke="{colour}" stroke-width="2"/>{title}</g>'


def _label(name: str, angle: float, center: float, radius: float) -> str:
    """The end of an image's name, outside the circle and readable from without."""
    x, y = center + (radius + 9) * math.cos(angle), center + (radius + 9) * math.sin(angle)
    flip = math.cos(angle) < 0
    turn = math.degrees(angle) + (180 if flip else 0)
    short = name.rpartition("/")[2][-14:]
    return (
        f'<text transform="translate({x:.1f} {y:.1f}) rotate({turn:.1f})" dominant-baseline="middle" '
        f'text-anchor="{"end" if flip else "start"}">{html.escape(short)}</text>'
    )
