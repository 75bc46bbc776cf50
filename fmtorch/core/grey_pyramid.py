"""A grey image at ever coarser scales, made once for all pairs that show it."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

LEVELS = 5  # at most
MIN_SIDE = 32  # px, of a level that has a coarser one
SMOOTHING = (
    0.5  # px, of every level: bilinear interpolation then lowers contrast nearly alike between pixels and on them
)


class GreyPyramid(NamedTuple):
    """Levels of an image, each of half the samples of the one before: point x of the image is at x / 2^l of level l.

    pixels: (sum,) uint8, the grey levels of all, row by row. levels: (l, 3) int64, of each its height, its width and
    where it begins in `pixels`. Four thirds of a byte for each pixel of the image.
    """

    pixels: NDArray[np.uint8]
    levels: NDArray[np.int64]


def grey_pyramid(image: NDArray[np.uint8]) -> GreyPyramid:
    """The pyramid of a grey image (H, W): Burt and Adelson, The Laplacian Pyramid as a Compact Image Code, 1983.

    Every other sample is taken of an image smoothed by a binomial filter; what is kept of each is smoothed slightly.
    """
    import cv2  # not before an image is there: protocols of matches alone name this file

    images: list[Any] = [image]
    while len(images) < LEVELS and min(images[-1].shape) >= MIN_SIDE:
        images.append(cv2.pyrDown(images[-1]))
    begins = np.cumsum([0, *(level.size for level in images[:-1])])
    levels = np.array([(*level.shape, begin) for level, begin in zip(images, begins, strict=True)], np.int64)
    return GreyPyramid(np.concatenate([cv2.GaussianBlur(level, (3, 3), SMOOTHING).ravel() for level in images]), levels)
