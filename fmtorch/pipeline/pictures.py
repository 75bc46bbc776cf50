"""Two images on one canvas: where each stands, its lines and points in pixels of the canvas, a caption below."""

import base64
import dataclasses
from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.core.checks import as_tensor, checked
from fmtorch.pipeline.photographs import GivenImage, Image, given_image
from fmtorch.two_view.arguments import Arrays

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
        return np.asarray((x + 0.5) * (np.array(self.size) / self.shape[::-1]) - 0.5 + self.origin, np.float64)

    def view(self, canvas: Image) -> Image:
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
    end = np.add(origins[1], sizes[1])
    canvas = np.full((end[1], end[0], 3), 255, np.uint8)
    places = []
    for image, shape, origin, size in zip((image0, image1), shapes, origins, sizes, strict=True):
        place = Place((shape[0], shape[1]), origin, size)
        place.view(canvas)[:] = _faded(image, size)
        places.append(place)
    return canvas, places[0], places[1]


def _faded(image: Image, size: tuple[int, int]) -> Image:
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


def headed(picture: Image, text: str, doubtful: bool) -> Image:
    """The picture with a line above it, red where it is not to be relied on."""
    size = max(0.45, 0.62 * picture.shape[1] / WIDTH)
    while size > 0.2 and cv2.getTextSize(text, _FONT, size, 1)[0][0] > picture.shape[1] - 22 * size:
        size *= 0.9
    line = np.full((round(44 * size), picture.shape[1], 3), 255, np.uint8)
    colour = (190, 20, 20) if doubtful else (0, 0, 0)
    cv2.putText(line, text, (round(11 * size), round(30 * size)), _FONT, size, colour, line_width(size), cv2.LINE_AA)
    return np.concatenate([line, picture])


def jpeg_url(image: Image, quality: int = 95) -> str:
    """An image, RGB or grey, as the URL of a JPEG file that holds it."""
    image = image[..., ::-1] if image.ndim == 3 else image
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


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
    """Points (N, 2) as OpenCV takes them with `SUBPIXEL` fractional bits, in 32 bits."""
    return [(int(x), int(y)) for x, y in np.round((points * (1 << SUBPIXEL)).clip(-(2**30), 2**30)).astype(int)]


# RGB; told apart by all kinds of colour vision (Okabe & Ito), lightened.
COLOURS = (
    (0, 158, 235), (240, 228, 66), (230, 100, 10), (20, 190, 130), (225, 130, 185), (110, 205, 250), (245, 170, 0),
)  # fmt: skip
_CORNERS = 200  # among which to choose
_RIM = 0.06  # share of an image at either side without corners


@checked
def draw_matches(
    image0: GivenImage, image1: GivenImage, x0: Arrays, x1: Arrays, inliers: Arrays | None = None,
    *, height: int | None = None, most: int = 90, most_bad: int = 50, names: tuple[str, str] | None = None,
) -> Image:  # fmt: skip
    """Two images side by side, uint8 RGB (H, W, 3), with their matches as lines: inliers green, others thin and red.

    Args:
        image0, image1: files, images of Pillow, or uint8 arrays. Wide ones stand one above the other.
        x0, x1: matched points (N, 2), pixels.
        inliers: which of them are, (N,); all when not given.
        height: of the picture, px; None: as fits `WIDTH` x `HEIGHT`.
        most, most_bad: lines of each kind at most; where there are more, every part of image 0 shows its fraction.
        names: what inliers and others are called in a line below, which also counts them; None: no such line.

    Raises:
        ValueError, TypeError: for what is no image, and points or inliers of another shape.
    """
    x0, x1 = _points(x0, "x0"), _points(x1, "x1")
    good = np.ones(len(x0), bool) if inliers is None else _array(inliers, "inliers").astype(bool)
    if not len(x0) == len(x1) == good.size:
        raise ValueError(f"x0, x1 and inliers have {len(x0)}, {len(x1)} and {good.size} entries; they must be equal")
    good = good.reshape(-1)
    canvas, place0, place1 = placed(given_image(image0, "image0"), given_image(image1, "image1"), height)
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


@checked
def draw_epipolar_lines(
    image0: GivenImage, image1: GivenImage, x0: Arrays, x1: Arrays, F: Arrays,
    *, truth: Arrays | None = None, most: int = 14,
) -> Image:  # fmt: skip
    """Two images with some of their matches as points and the matches' epipolar lines, ``x1^T F x0 = 0``.

    The picture is uint8 RGB (H, W, 3). A match has one colour: its point and the line of its partner in each image.

    Args:
        image0, image1, x0, x1: as of `draw_matches`; give inliers.
        F: (3, 3).
        truth: the true F, whose lines are dashed and white.
        most: matches at most, spread over both images.

    Raises:
        ValueError, TypeError: for what is no image, no points (N, 2) and no matrix (3, 3).
    """
    x0, x1, F = _points(x0, "x0"), _points(x1, "x1"), _matrix(F, "F")
    if len(x0) != len(x1):
        raise ValueError(f"x0 has {len(x0)} points and x1 {len(x1)}; they must be equal")
    truth = None if truth is None else _matrix(truth, "truth")
    canvas, place0, place1 = placed(given_image(image0, "image0"), given_image(image1, "image1"), None)
    finite = np.flatnonzero(np.isfinite(x0).all(1) & np.isfinite(x1).all(1))
    index = finite[spread(np.hstack([place0(x0), place1(x1)])[finite], most)]
    for place, own, other, transpose in ((place0, x0, x1, True), (place1, x1, x0, False)):
        matrices = [(matrix.T if transpose else matrix) for matrix in (F, truth) if matrix is not None]
        _lines_and_points(canvas, place, _lines(place, matrices, other[index]), own[index], 0)
    return canvas


def _array(values: Arrays, name: str) -> NDArray[np.float64]:
    return np.asarray(as_tensor(values, name).detach().cpu().double().numpy())


def _points(x: Arrays, name: str) -> NDArray[np.float64]:
    """Points (N, 2) of an array, a tensor, a batch of one, or OpenCV's (N, 1, 2). Raises ValueError for others."""
    points = _array(x, name)
    points = points.reshape(-1, 2) if points.ndim == 3 and 1 in points.shape[:2] and points.shape[2] == 2 else points
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"{name} has shape {points.shape}; it must be (N, 2)")
    return points


def _matrix(F: Arrays, name: str) -> NDArray[np.float64]:
    """The matrix (3, 3) of an array, a tensor, or a batch of one. Raises ValueError for another shape."""
    matrix = _array(F, name)
    if matrix.size != 9:
        raise ValueError(f"{name} has shape {matrix.shape}; it must be (3, 3), of one pair")
    return matrix.reshape(3, 3)


def draw_epipolar_lines_of_corners(image0: Image, image1: Image, F: Points, *, truth: Points | None = None) -> Image:
    """Two images with some of their own corners as points, and the epipolar line of each in the other image; RGB.
    For an F whose matches are not known. A point and its line have one colour, which no other point has; more than half
    of the points lie in image 0. Where there is a choice they are corners whose true line crosses the other image.
    truth: as for `draw_epipolar_lines`."""
    canvas, place0, place1 = placed(image0, image1, None)
    known = F if truth is None else truth
    chosen0 = _corners(image0, place1.clip, known, len(COLOURS) - len(COLOURS) // 2)
    chosen1 = _corners(image1, place0.clip, known.T, len(COLOURS) // 2)
    both = [matrix for matrix in (F, truth) if matrix is not None]
    first = len(chosen0)
    _lines_and_points(canvas, place0, _lines(place0, [matrix.T for matrix in both], chosen1), chosen0, 0, first)
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
    canvas: Image, place: Place, lines: Sequence[Sequence[NDArray[np.float64]]], points: Points, colour: int,
    line_colour: int | None = None,
) -> None:  # fmt: skip
    """Draw in one image lines and, dashed and white, true lines if `lines` has them; then points on top.
    colour, line_colour: the colours' numbers of the first point and, if it is another, the first line."""
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
    The first is the nearest to the mean. O(N count). Ties go to the lowest index."""
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
    matches so do right and wrong ones, whereas `spread` prefers what is far from the rest: the wrong."""
    if len(points) <= count:
        return np.arange(len(points))
    x, y = points.T
    strip = np.floor((x - x.min()) / max(np.ptp(x), np.finfo(np.float64).tiny) * np.sqrt(count))
    path = np.lexsort((np.where(strip % 2 == 0, y, -y), strip))
    return np.sort(path[(2 * np.arange(count) + 1) * len(points) // (2 * count)])
