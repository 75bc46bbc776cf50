"""A picture of a view graph as SVG: images on a circle, those that see the same things side by side."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.io.export import Edge, ViewGraph

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

    Pairs weigh as the logarithm of one more than their inliers. More images than MAX_SPECTRAL stay as they are.
    """
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
    small = cv2.resize(picture, (2 * w, 2 * h), interpolation=cv2.INTER_AREA)
    small = small[..., ::-1] if small.ndim == 3 else small
    encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    data = base64.b64encode(encoded.tobytes()).decode()
    box = f'x="{x - w / 2:.1f}" y="{y - h / 2:.1f}" width="{w}" height="{h}"'
    return (
        f'<g><image {box} href="data:image/jpeg;base64,{data}"/>'
        f'<rect {box} fill="none" stroke="{colour}" stroke-width="2"/>{title}</g>'
    )


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
