"""Two images on one canvas: where each stands, its lines and points in pixels of the canvas, a caption below."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Points = NDArray[np.floating]
# RGB; told apart by all kinds of colour vision, and in grey (Okabe & Ito, "Color Universal Design", 2008), lightened.
GOOD, BAD = (20, 205, 140), (225, 75, 20)
WIDTH, HEIGHT = 1920, 1000  # px, of a picture at most
SUBPIXEL = 4  # fractional bits of the coordinates that are drawn
_GAP = 6  # px between the two images
_STACKED = 5.0  # images whose widths add up to more than so many heights stand one above the other
_PARALLEL = 1e-9  # a line with this slope at most leaves an image only at its two other sides
_FARTHEST = 1e12  # px; a line farther from the first pixel is the line at infinity
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_COLOUR_LEFT = 0.45  # of the photographs' own, so that lines stand out


@dataclasses.dataclass(frozen=True)
class Place:
    """Where an image of `shape` (h, w) stands on the canvas: its first corner (x, y) and its size (w, h) there."""

    shape: tuple[int, int]
    origin: tuple[int, int]
    size: tuple[int, int]

    def __call__(self, x: Points) -> NDArray[np.float64]:
        """Pixels of the image as pixels of the canvas; (0, 0) is the centre of the first pixel of either."""
        scale = np.array(self.size) / self.shape[::-1]
        return np.asarray((x + 0.5) * scale - 0.5 + self.origin, np.float64)

    def view(self, canvas: Image) -> Image:
        """The image's part of the canvas."""
        return canvas[self.origin[1] : self.origin[1] + self.size[1], self.origin[0] : self.origin[0] + self.size[0]]

    def clip(self, line: Points) -> NDArray[np.float64]:
        """The part of a line (a, b, c) within the image: its ends (2, 2) in pixels of `view`; (0, 2) where none is."""
        w, h = self.shape[::-1]
        length = float(np.hypot(line[0], line[1]))
        if not np.isfinite(line).all() or length <= abs(line[2]) / _FARTHEST:
            return np.zeros((0, 2))
        normal, middle = line[:2] / length, np.array([w - 1, h - 1]) / 2
        foot = middle - normal * (normal @ middle + line[2] / length)
        direction = np.array([-normal[1], normal[0]])
        first, last = -np.inf, np.inf
        for start, step, low, high in zip(foot, direction, (-0.5, -0.5), (w - 0.5, h - 0.5), strict=True):
            if abs(step) < _PARALLEL:
                if not low <= start <= high:
                    return np.zeros((0, 2))
                continue
            near, far = sorted(((low - start) / step, (high - start) / step))
            first, last = max(first, near), min(last, far)
        if first > last:
            return np.zeros((0, 2))
        return self(foot + np.array([[first], [last]]) * direction) - self.origin


def placed(image0: Image, image1: Image, height: int | None) -> tuple[Image, Place, Place]:
    """A canvas with both images, and where they stand on it: in a row of one height, or in a column of one width."""
    shapes = [image.shape[:2] for image in (image0, image1)]
    widths = [w / h for h, w in shapes]  # at height 1
    if height is None and sum(widths) > _STACKED:
        width = min(WIDTH, (HEIGHT - _GAP) / sum(1 / x for x in widths))
        sizes = [(max(1, round(width)), max(1, round(width / x))) for x in widths]
        origins = [(0, 0), (0, sizes[0][1] + _GAP)]
    else:
        tall = height or min(HEIGHT, (WIDTH - _GAP) / sum(widths))
        sizes = [(max(1, round(tall * x)), max(1, round(tall))) for x in widths]
        origins = [(0, 0), (sizes[0][0] + _GAP, 0)]
    end = np.array(origins[1]) + np.max(sizes, axis=0) * [origins[1][0] == 0, origins[1][1] == 0]
    end += np.array(sizes[1]) * [origins[1][0] > 0, origins[1][1] > 0]
    canvas = np.full((end[1], end[0], 3), 255, np.uint8)
    places = []
    for image, shape, origin, size in zip((image0, image1), shapes, origins, sizes, strict=True):
        place = Place((shape[0], shape[1]), origin, size)
        place.view(canvas)[:] = _faded(image, size)
        places.append(place)
    return canvas, places[0], places[1]


def _faded(image: Image, size: tuple[int, int]) -> Image:
    """The image in another size (w, h) and paler colours."""
    shrinks = size[0] < image.shape[1]
    image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC), np.uint8)
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, 2)
    grey = np.repeat(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))[..., None], 3, 2)
    return np.asarray(cv2.addWeighted(image, _COLOUR_LEFT, grey, 1 - _COLOUR_LEFT, 0), np.uint8)


def captioned(canvas: Image, names: tuple[str, str], counts: tuple[int, int], drawn: tuple[int, int]) -> Image:
    """The picture with a line below it that says what its two colours are."""
    size = max(0.45, 0.62 * canvas.shape[1] / WIDTH)  # of letters, in OpenCV's unit
    height, gap, rise = round(44 * size), round(22 * size), round(30 * size)
    line = np.full((height, canvas.shape[1], 3), 255, np.uint8)
    x = gap
    for colour, name, count, shown in zip((GOOD, BAD), names, counts, drawn, strict=True):
        text = f"{count} {name}" + (f", {shown} of them drawn" if shown < count else "")
        cv2.line(line, (x, rise - round(7 * size)), (x + 2 * gap, rise - round(7 * size)), colour, line_width(5 * size))
        cv2.putText(line, text, (x + 3 * gap, rise), _FONT, size, (0, 0, 0), line_width(1.3 * size), cv2.LINE_AA)
        x += 5 * gap + cv2.getTextSize(text, _FONT, size, line_width(1.3 * size))[0][0]
    return np.concatenate([canvas, line])


def fine_line(canvas: Image) -> float:
    """The width of a fine line: 1 px for a picture of WIDTH x 640."""
    return float(np.sqrt(canvas.shape[0] * canvas.shape[1] / (WIDTH * 640)))


def line_width(width: float) -> int:
    """A width that OpenCV can draw."""
    return max(1, round(width))


def segment(canvas: Image, ends: Points, colour: tuple[int, int, int], width: float) -> None:
    """A line on a dark rim, which can be seen on any ground."""
    if len(ends):
        a, b = fixed(ends)
        cv2.line(canvas, a, b, (0, 0, 0), line_width(width) + 2, cv2.LINE_AA, SUBPIXEL)
        cv2.line(canvas, a, b, colour, line_width(width), cv2.LINE_AA, SUBPIXEL)


def dashes(ends: Points, length: float) -> Iterator[Points]:
    """Pieces of a line with gaps of the same length between them."""
    if len(ends):
        pieces = max(1, round(float(np.linalg.norm(ends[1] - ends[0])) / length))
        stops = ends[0] + np.linspace(0, 1, pieces + 1)[:, None] * (ends[1] - ends[0])
        yield from (stops[i : i + 2] for i in range(0, pieces, 2))


def fixed(points: Points) -> list[tuple[int, int]]:
    """Points (N, 2) as OpenCV takes them with `SUBPIXEL` fractional bits."""
    rounded = np.round(points * (1 << SUBPIXEL)).astype(int)
    return [(int(x), int(y)) for x, y in rounded]
