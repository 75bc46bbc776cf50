"""Depth measured for each pixel of a photograph, kept as images of 16 bits."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.data.images import ImageError
from fmtorch.data.pairs import ImageSource

_KEPT = 8  # depth images that are remembered, 0.6 MB each


class DepthImages:
    """Depth images by the identity of the photographs, pixel by pixel on the photographs as they were taken.

    paths: of the depth images. scale: their values per unit of length; 0 is no measurement.
    """

    def __init__(self, paths: Mapping[str, Path], scale: float) -> None:
        self.paths, self.scale = dict(paths), scale

    def at(self, image: ImageSource, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth (n,) along the optical axis at points (n, 2) of the undistorted image: that of the nearest pixel.

        NaN outside, where nothing was measured, and everywhere in a photograph without a depth image. Raises ImageError
        for a file that cannot be read or has another size than the photograph.
        """
        if image.identity not in self.paths:
            return np.full(len(points), np.nan)
        pixels = _read(self.paths[image.identity])
        if image.size is not None and pixels.shape != image.size:
            raise ImageError(f"{self.paths[image.identity]}: {pixels.shape} px; its photograph has {image.size}")
        there = points if image.lens is None else image.lens.distort(points)
        column, row = np.round(np.nan_to_num(there, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < pixels.shape[1]) & (row < pixels.shape[0])
        value = np.where(inside, pixels[np.where(inside, row, 0), np.where(inside, column, 0)], 0)
        return np.where(value > 0, value / self.scale, np.nan)


@functools.lru_cache(maxsize=_KEPT)
def _read(path: Path) -> NDArray[np.uint16]:
    if not path.is_file():
        raise ImageError(f"{path}: no such file; it must be a depth image")
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise ImageError(f"{path}: it must be a depth image, grey with 16 bits")
    return pixels  # type: ignore[return-value]
