"""Pictures of matched pairs."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
GOOD, BAD = (60, 190, 90), (225, 70, 60)  # RGB
_GAP = 6  # px between the two images
_SUBPIXEL = 4  # fractional bits of the coordinates that are drawn


def draw_matches(
    image0: Image, image1: Image, x0: NDArray[np.floating], x1: NDArray[np.floating], good: NDArray[np.bool_],
    *, height: int = 480, most: int = 150,
) -> Image:  # fmt: skip
    """Two images side by side, their matches as lines: green where good, red elsewhere; RGB (height, W, 3).

    x0, x1: (N, 2) pixels. most: lines of each colour at most, spread evenly over the list.
    """
    left, scale0 = _scaled(image0, height)
    right, scale1 = _scaled(image1, height)
    offset = left.shape[1] + _GAP
    canvas = np.full((height, offset + right.shape[1], 3), 255, np.uint8)
    canvas[:, : left.shape[1]], canvas[:, offset:] = left, right
    # (0, 0) is the centre of the first pixel, so scaling moves coordinates by half a pixel.
    ends0 = (x0 + 0.5) * scale0 - 0.5
    ends1 = (x1 + 0.5) * scale1 - 0.5 + [offset, 0]
    for colour, chosen in ((BAD, ~good), (GOOD, good)):
        index = np.flatnonzero(chosen)
        if len(index) > most:
            index = index[np.linspace(0, len(index) - 1, most).round().astype(int)]
        for a, b in zip(_fixed(ends0[index]), _fixed(ends1[index]), strict=True):
            cv2.line(canvas, a, b, colour, 1, cv2.LINE_AA, _SUBPIXEL)
        for point in _fixed(np.concatenate([ends0[index], ends1[index]])):
            cv2.circle(canvas, point, 2 << _SUBPIXEL, colour, -1, cv2.LINE_AA, _SUBPIXEL)
    return canvas


def _scaled(image: Image, height: int) -> tuple[Image, float]:
    scale = height / image.shape[0]
    size = (max(1, round(image.shape[1] * scale)), height)
    colour = image if image.ndim == 3 else np.repeat(image[..., None], 3, 2)
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(colour, size, interpolation=interpolation), np.uint8), scale


def _fixed(points: NDArray[np.floating]) -> list[tuple[int, int]]:
    whole = np.round(points * (1 << _SUBPIXEL)).astype(int)
    return [(int(x), int(y)) for x, y in whole]
