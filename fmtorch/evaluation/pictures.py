"""Pictures of matched pairs: their matches, and the epipolar lines of some of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.evaluation.canvas import (
    BAD,
    GOOD,
    SUBPIXEL,
    Image,
    Place,
    Points,
    captioned,
    dashes,
    fine_line,
    fixed,
    line_width,
    placed,
    segment,
)  # fmt: skip

# RGB; told apart by all kinds of colour vision (Okabe & Ito), lightened.
COLOURS = (
    (0, 158, 235),
    (240, 228, 66),
    (230, 100, 10),
    (20, 190, 130),
    (225, 130, 185),
    (110, 205, 250),
    (245, 170, 0),
)
_CORNERS = 200  # among which to choose
_RIM = 0.06  # share of an image at either side without corners


def draw_matches(
    image0: Image, image1: Image, x0: Points, x1: Points, good: NDArray[np.bool_],
    *, height: int | None = None, most: int = 90, most_bad: int = 50, names: tuple[str, str] | None = None,
) -> Image:  # fmt: skip
    """Two images side by side with their matches as lines, green where good, thin and red elsewhere; RGB (H, W, 3).

    Wide images stand one above the other. x0, x1: (N, 2) pixels. height: side by side in this height; None: as fits
    `WIDTH` x `HEIGHT`. most, most_bad: lines of each kind at most; where there are more matches, every part of image 0
    shows its share of them. names: what good and other matches are called in a line below the images, which also says
    how many there are and how many are drawn; None: no such line.
    """
    canvas, place0, place1 = placed(image0, image1, height)
    ends0, ends1 = place0(x0), place1(x1)
    unit = fine_line(canvas)
    styles = ((BAD, ~good, most_bad, 0.6 * unit, 0.6), (GOOD, good, most, 1.1 * unit, 0.85))
    for colour, chosen, count, width, opacity in styles:
        index = np.flatnonzero(chosen & np.isfinite(ends0).all(1) & np.isfinite(ends1).all(1))
        index = index[thinned(ends0[index], count)]
        layer = canvas.copy()
        for a, b in zip(fixed(ends0[index]), fixed(ends1[index]), strict=True):
            cv2.line(layer, a, b, colour, line_width(width), cv2.LINE_AA, SUBPIXEL)
        for point in fixed(np.concatenate([ends0[index], ends1[index]])):
            cv2.circle(layer, point, round(2.6 * width * (1 << SUBPIXEL)), colour, -1, cv2.LINE_AA, SUBPIXEL)
        canvas = np.asarray(cv2.addWeighted(layer, opacity, canvas, 1 - opacity, 0), np.uint8)
    if names is None:
        return canvas
    counts = int(good.sum()), int((~good).sum())
    return captioned(canvas, names, counts, (min(counts[0], most), min(counts[1], most_bad)))


def draw_epipolar_lines(
    image0: Image, image1: Image, x0: Points, x1: Points, F: Points, *, truth: Points | None = None, most: int = 14
) -> Image:
    """Two images with some of their matches as points and the matches' epipolar lines, ``x1^T F x0 = 0``; RGB.

    A match has one colour: its point and the line of its partner in each image. truth: the true F, whose lines are
    dashed and white. x0, x1: (N, 2) pixels, of which `most` are drawn at most, spread over both images.
    """
    canvas, place0, place1 = placed(image0, image1, None)
    finite = np.flatnonzero(np.isfinite(x0).all(1) & np.isfinite(x1).all(1))
    index = finite[spread(np.hstack([place0(x0), place1(x1)])[finite], most)]
    for place, own, other, transpose in ((place0, x0, x1, True), (place1, x1, x0, False)):
        matrices = [(matrix.T if transpose else matrix) for matrix in (F, truth) if matrix is not None]
        _lines_and_points(canvas, place, _lines(place, matrices, other[index]), own[index], 0)
    return canvas


def draw_epipolar_lines_of_corners(
    image0: Image, image1: Image, F: Points, *, truth: Points | None = None, most: int = 7
) -> Image:
    """Two images with some of their own corners as points, and the epipolar line of each in the other image; RGB.

    For an F whose matches are not known. A point and its line have one colour, which no other point has where `most` is
    that of `COLOURS` or fewer; more than half of the points lie in image 0. Where there is a choice they are corners
    whose true line crosses the other image. truth: as for `draw_epipolar_lines`.
    """
    canvas, place0, place1 = placed(image0, image1, None)
    known = F if truth is None else truth
    chosen0 = _corners(image0, lambda line: place1.clip(line), known, most - most // 2)
    chosen1 = _corners(image1, lambda line: place0.clip(line), known.T, most // 2)
    both = [matrix for matrix in (F, truth) if matrix is not None]
    first = len(chosen0)
    lines0 = _lines(place0, [matrix.T for matrix in both], chosen1)
    _lines_and_points(canvas, place0, lines0, chosen0, 0, first)
    _lines_and_points(canvas, place1, _lines(place1, both, chosen0), chosen1, first, 0)
    return canvas


def _corners(image: Image, clip: Callable[[Points], NDArray[np.float64]], F: Points, count: int) -> NDArray[np.float64]:
    """At most `count` corners of an image, (n, 2), far from one another; those first whose line `clip` finds."""
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    inner = np.zeros(grey.shape, np.uint8)  # the rims of undistorted images have corners of their own
    rows, columns = (slice(int(_RIM * size), size - int(_RIM * size)) for size in grey.shape)
    inner[rows, columns] = 255
    detected = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.02, max(2.0, min(grey.shape) / 40), mask=inner)
    if detected is None:
        return np.zeros((0, 2))
    corners = np.asarray(detected, np.float64).reshape(-1, 2)
    seen = np.array([len(clip(F @ [x, y, 1.0])) > 0 for x, y in corners])
    corners = corners[seen] if seen.any() else corners
    return corners[spread(corners, count)]


def _lines(place: Place, matrices: Sequence[Points], points: Points) -> list[list[NDArray[np.float64]]]:
    """Of each matrix the ends of the points' epipolar lines in the image at `place`."""
    homogeneous = np.column_stack([points, np.ones(len(points))])
    return [[place.clip(line) for line in homogeneous @ matrix.T] for matrix in matrices]


def _lines_and_points(
    canvas: Image,
    place: Place,
    lines: Sequence[Sequence[NDArray[np.float64]]],
    points: Points,
    colour: int,
    line_colour: int | None = None,
) -> None:
    """Draw in one image lines and, dashed and white, true lines if `lines` has them; then points on top.

    colour, line_colour: the colours' numbers of the first point and, if it is another, the first line.
    """
    part, unit = place.view(canvas), fine_line(canvas)
    start = colour if line_colour is None else line_colour
    for k, ends in enumerate(lines[0], start):
        segment(part, ends, COLOURS[k % len(COLOURS)], 1.9 * unit)
    for ends in lines[1] if len(lines) > 1 else []:
        for dash in dashes(ends, 15 * unit):
            segment(part, dash, (255, 255, 255), 1.3 * unit)
    for k, point in enumerate(fixed(place(points) - place.origin), colour):
        for ring, radius in (((0, 0, 0), 5.8), ((255, 255, 255), 5.0), (COLOURS[k % len(COLOURS)], 3.6)):
            cv2.circle(part, point, round(radius * unit * (1 << SUBPIXEL)), ring, -1, cv2.LINE_AA, SUBPIXEL)


def spread(points: Points, count: int) -> NDArray[np.intp]:
    """Indices, ascending, of at most `count` points (N, D) far from one another: each the farthest from those before.

    The first is the nearest to the mean. O(N count). Ties go to the lowest index.
    """
    if len(points) <= count:
        return np.arange(len(points))
    distance = -((points - points.mean(0)) ** 2).sum(1)
    chosen = [int(distance.argmax())]
    distance = np.full(len(points), np.inf)
    for _ in range(count - 1):
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(distance.argmax()))
    return np.sort(np.array(chosen, np.intp))


def thinned(points: Points, count: int) -> NDArray[np.intp]:
    """Indices, ascending, of at most `count` points (N, 2): of a path through all of them every so many-th.

    The path goes up one strip of the plane and down the next. Dense and sparse regions keep their shares, and among
    matches so do right and wrong ones, whereas `spread` prefers what is far from the rest: the wrong.
    """
    if len(points) <= count:
        return np.arange(len(points))
    x, y = points.T
    strip = np.floor((x - x.min()) / max(np.ptp(x), np.finfo(np.float64).tiny) * np.sqrt(count))
    path = np.lexsort((np.where(strip % 2 == 0, y, -y), strip))
    return np.sort(path[(2 * np.arange(count) + 1) * len(points) // (2 * count)])
