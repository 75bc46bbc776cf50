"""A real pair with measured disparity, the Middlebury motorcycle that the scikit-image package carries."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from fmtorch.data.pairs import ImagePair, ImageSource
from fmtorch.data.rendered.photographs import skimage_file
from fmtorch.data.rendered.pinhole import Camera, calibration, fundamental, relative_pose

_FILES = ("motorcycle_left.png", "motorcycle_right.png", "motorcycle_disp.npz")
# Calibration of the pictures as shipped (a quarter of the published resolution); see skimage.data.stereo_motorcycle.
_FOCAL, _CENTRE, _SHIFT, _BASELINE, _SIZE = 994.978, (311.193, 254.877), 31.086, 0.193001, (500, 741)


class StereoPair(Dataset[ImagePair]):
    """One rectified pair with dense ground truth: a point (x, y) on the left is (x - disparity, y) on the right.

    The three files lie inside scikit-image's wheel, so that nothing is downloaded; FileNotFoundError names the one
    that is absent. root: another folder that holds them.
    Source: Scharstein et al., High-resolution stereo datasets with subpixel-accurate ground truth, GCPR 2014.
    """

    name = "stereo"

    def __init__(self, root: str | Path | None = None) -> None:
        self._paths = [skimage_file(name) if root is None else Path(root) / name for name in _FILES]
        for path in self._paths:
            if not path.is_file():
                raise FileNotFoundError(f"{path} is absent; the stereo pair needs {', '.join(_FILES)}")
        self.digest = hashlib.sha256(b"".join(path.read_bytes() for path in self._paths)).hexdigest()
        x, y = _CENTRE
        left = Camera(calibration(_FOCAL, _SIZE, (x, y)), np.eye(3), np.zeros(3), _SIZE)
        right = Camera(calibration(_FOCAL, _SIZE, (x + _SHIFT, y)), np.eye(3), np.array([-_BASELINE, 0.0, 0.0]), _SIZE)
        R, t = relative_pose(left, right)
        self._pair = ImagePair(
            identity=f"{self.name}/motorcycle/left-right",
            family=self.name,
            scene="motorcycle",
            image0=ImageSource("motorcycle/left", self._paths[0]),
            image1=ImageSource("motorcycle/right", self._paths[1]),
            F=fundamental(left, right),
            K0=left.K,
            K1=right.K,
            R=R,
            t=t,
        )

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> ImagePair:
        if index not in (0, -1):
            raise IndexError(f"pair {index} of a data set of one pair")
        return self._pair

    def __iter__(self) -> Iterator[ImagePair]:
        yield self._pair

    def matches(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Points (n, 2) on the left and where they are on the right, for every pixel with a measured disparity."""
        with np.load(self._paths[2]) as file:
            disparity = file["arr_0"].astype(np.float64)
        known = np.isfinite(disparity)
        y, x = np.nonzero(known)
        left = np.stack([x, y], -1).astype(np.float64)
        right = left - np.stack([disparity[known], np.zeros(len(left))], -1)
        inside = (right[:, 0] >= 0) & (right[:, 0] <= disparity.shape[1] - 1)
        return left[inside], right[inside]
