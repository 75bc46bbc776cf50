"""Images resized and turned when they are read, as evaluation protocols ask, and cameras of what is read."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Size = tuple[int, int]  # (h, w), px


@dataclasses.dataclass(frozen=True)
class Resampling:
    """What happens to an image of a file after it is decoded: first it is resized, then turned.

    size: (h, w) to which it is resized, by areas where both sides shrink, bilinearly otherwise; None: its own.
    quarter_turns: by which it is turned counterclockwise, 0 to 3, as `np.rot90` does and SuperGlue's lists count.
    """

    size: Size | None = None
    quarter_turns: int = 0

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image (H, W) or (H, W, 3) resized and turned."""
        if self.size is not None and image.shape[:2] != self.size:
            shrinks = self.size[0] <= image.shape[0] and self.size[1] <= image.shape[1]
            kind = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            image = np.asarray(cv2.resize(image, self.size[::-1], interpolation=kind), np.uint8)
        return np.ascontiguousarray(np.rot90(image, self.quarter_turns)) if self.quarter_turns else image

    def matrix(self, size: Size) -> Matrix:
        """The affine map (3, 3) from pixels of an image of `size` (h, w) to pixels of what is read.

        (0, 0) is the centre of the first pixel of either: resizing by s moves x to ``(x + 0.5) s - 0.5``.
        """
        h, w = self.size or size
        sy, sx = h / size[0], w / size[1]
        resized = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1.0]])
        for turn in range(self.quarter_turns):
            width = w if turn % 2 == 0 else h
            resized = np.array([[0, 1.0, 0], [-1.0, 0, width - 1], [0, 0, 1.0]]) @ resized
        return resized

    @property
    def rotation(self) -> Matrix:
        """The rotation (3, 3) of the camera's axes that goes with the turn: x right and y down of the turned image."""
        quarter = np.array([[0, 1.0, 0], [-1.0, 0, 0], [0, 0, 1.0]])
        rotation: Matrix = np.linalg.matrix_power(quarter, self.quarter_turns)
        return rotation

    def calibration(self, K: Matrix, size: Size) -> Matrix:
        """The calibration (3, 3) of what is read, K being that of an image of `size`: ``matrix K rotation^T``."""
        calibration: Matrix = self.matrix(size) @ K @ self.rotation.T
        return calibration


def longer_side(size: Size, length: int) -> Size:
    """The size (h, w) of the same shape whose longer side is `length`."""
    scale = length / max(size)
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def shorter_side(size: Size, length: int) -> Size:
    """The size (h, w) of the same shape whose shorter side is `length`."""
    scale = length / min(size)
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
