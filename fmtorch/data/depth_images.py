"""Depth of each pixel of a photograph, measured or reconstructed, kept in a file beside it."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.data.images import ImageError
from fmtorch.data.pairs import ImageSource

Values = NDArray[np.uint16] | NDArray[np.float32]
_KEPT = 8  # depth images that are remembered, some MB each
_COLMAP_HEADER = re.compile(rb"(\d{1,6})&(\d{1,6})&1&")


class DepthImages:
    """Depth images by the identity of the photographs, pixel by pixel on the photographs as they were taken.

    paths: of the depth images. scale: their values per unit of length; 0 and less is no measurement. read: the values
    (h, w) of a file. reduced: whether depth images may be smaller than their photographs, of the same proportions.
    """

    def __init__(
        self, paths: Mapping[str, Path], scale: float, read: Callable[[Path], Values], reduced: bool = False
    ) -> None:
        self.paths, self.scale, self.read, self.reduced = dict(paths), scale, read, reduced

    def at(self, image: ImageSource, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth (n,) along the optical axis at points (n, 2) of the undistorted image: that of the nearest pixel.

        NaN outside, where nothing was measured, and everywhere in a photograph without a depth image. Raises ImageError
        for a file that cannot be read or does not have the photograph's size.
        """
        if image.identity not in self.paths:
            return np.full(len(points), np.nan)
        path = self.paths[image.identity]
        pixels = self.read(path)
        h, w = pixels.shape
        if image.size is not None and not self._fits((h, w), image.size):
            raise ImageError(f"{path}: {(h, w)} px; its photograph has {image.size}")
        there = points if image.lens is None else image.lens.distort(points)
        if image.size is not None and image.size != (h, w):
            there = (there + 0.5) * [w / image.size[1], h / image.size[0]] - 0.5
        column, row = np.round(np.nan_to_num(there, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < w) & (row < h)
        value = np.where(inside, pixels[np.where(inside, row, 0), np.where(inside, column, 0)], 0).astype(np.float64)
        return np.where(value > 0, value / self.scale, np.nan)

    def _fits(self, size: tuple[int, int], photograph: tuple[int, int]) -> bool:
        """Whether a depth image has the size of its photograph, or the same proportions to a pixel."""
        (h, w), (height, width) = size, photograph
        return size == photograph or (self.reduced and h <= height and abs(h * width / height - w) <= 1)


@functools.lru_cache(maxsize=_KEPT)
def read_grey(path: Path) -> NDArray[np.uint16]:
    """A grey image with 16 bits (h, w). Raises ImageError for anything else."""
    _expect_file(path)
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise ImageError(f"{path}: it must be a depth image, grey with 16 bits")
    return pixels  # type: ignore[return-value]


@functools.lru_cache(maxsize=_KEPT)
def read_colmap(path: Path) -> NDArray[np.float32]:
    """A depth map of COLMAP's dense reconstruction (h, w): ``width&height&1&``, then float32, row by row.

    Raises ImageError for anything else.
    """
    _expect_file(path)
    content = path.read_bytes()
    header = _COLMAP_HEADER.match(content)
    if header is None:
        raise ImageError(f"{path}: it must be a depth map of COLMAP, which begins with width&height&1&")
    w, h = (int(number) for number in header.groups())
    there = len(content) - header.end()
    if there != 4 * w * h or not there:
        raise ImageError(f"{path}: {there} bytes of depth; {w} x {h} px have {4 * w * h}: is it truncated?")
    return np.frombuffer(content, np.dtype("<f4"), offset=header.end()).reshape(h, w)


def _expect_file(path: Path) -> None:
    if not path.is_file():
        raise ImageError(f"{path}: no such file; it must be a depth image")
