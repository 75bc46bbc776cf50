"""PoseBench's files of relative poses: a group for each pair, with ``x1``, ``x2`` (n, 2), ``camera1``, ``camera2``
(``model``, ``width``, ``height``, ``params``), ``R`` (3, 3) and ``t`` (3,), X2 = R X1 + t.

A size that is missing, or not positive, is that of the image, if there is one, or else of the principal point and the
points.

F relates pixels only where the cameras are pinholes: pairs of other models, unless their distortion is zero, become
pairs with a problem.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.data.pairs import GivenMatches, ImagePair, ImageSource
from fmtorch.data.text_files import DataError
from fmtorch.storage.exchange import h5
from fmtorch.storage.exchange.given import (
    Array,
    Size,
    broken,
    calibrated,
    expect_size,
    given,
    image,
    size_by_points,
    size_of,
)

FOCAL_LENGTHS = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2, "SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2, "FULL_OPENCV": 2}
"""Camera models that are pinholes where their distortion is zero, and how many focal lengths begin their parameters."""


@dataclasses.dataclass(frozen=True)
class PoseBenchMatches:
    """The matches of one pair. K: of both cameras. sizes: None where neither file nor image tells."""

    path: Path
    key: str
    K: tuple[Array, Array]
    sizes: tuple[Size | None, Size | None]

    def __call__(self) -> GivenMatches:
        """Read them. Raises DataError naming file and key."""
        with h5.opened(self.path) as file:
            x0, x1 = (h5.numbers(file, f"{self.key}/{name}", None, 2) for name in ("x1", "x2"))
        if len(x0) != len(x1):
            raise DataError(f"{self.path}: {self.key!r} has {len(x0)} points in x1 and {len(x1)} in x2")
        size0, size1 = (
            size_by_points(K, x) if size is None else size
            for size, K, x in zip(self.sizes, self.K, (x0, x1), strict=True)
        )
        return given(x0, x1, (size0, size1), (len(x0), len(x1)))


def posebench_pairs(root: Path, images: Path | None) -> Iterator[ImagePair]:
    """The pairs of a file, or of all files of a folder."""
    for path in h5.files(root):
        with h5.opened(path) as file:
            for key in h5.keys(file):
                yield _pair(file, path, root.stem, key, images)


def _pair(file: Any, path: Path, family: str, key: str, images: Path | None) -> ImagePair:
    scene, identity = path.stem, f"{path.stem}/{key}"
    sources = image(family, scene, f"{key}/1", images), image(family, scene, f"{key}/2", images)
    try:
        (K0, size0), (K1, size1) = (
            _camera(file, path, f"{key}/{name}", source)
            for name, source in zip(("camera1", "camera2"), sources, strict=True)
        )
        R, t = h5.reshaped(file, f"{key}/R", 3, 3), h5.reshaped(file, f"{key}/t", 3)
    except DataError as error:
        return broken(identity, family, scene, sources, str(error))
    pair = calibrated(identity, family, scene, sources, (K0, K1), R, t)
    return dataclasses.replace(pair, matches=PoseBenchMatches(path, key, (K0, K1), (size0, size1)))


def _camera(file: Any, path: Path, key: str, source: ImageSource) -> tuple[Array, Size | None]:
    """Calibration matrix, and size where the file or the image tells it."""
    model = h5.text(file, f"{key}/model")
    parameters = h5.numbers(file, f"{key}/params").reshape(-1)
    count = FOCAL_LENGTHS.get(model)
    if count is None:
        raise DataError(f"{path}: {key + '/model'!r} is {model}; it must be one of {', '.join(FOCAL_LENGTHS)}")
    if len(parameters) < count + 2 or not np.isfinite(parameters).all():
        raise DataError(f"{path}: {key + '/params'!r} holds {parameters}, which are no parameters of {model}")
    if parameters[count + 2 :].any():
        raise DataError(f"{path}: {key + '/params'!r} of {model} has distortion; F needs undistorted points")
    fx, fy = (parameters[0], parameters[count - 1])
    cx, cy = parameters[count : count + 2]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    sides = [_side(file, f"{key}/{name}") for name in ("height", "width")]
    if all(sides):
        return K, (sides[0], sides[1])
    size = size_of(source)
    if size is not None:
        expect_size(source, size, K)
    return K, size


def _side(file: Any, key: str) -> int:
    """A side of an image in pixels, 0 where it is not known: some of PoseBench's cameras have none."""
    return max(0, int(h5.reshaped(file, key, 1)[0])) if h5.holds(file, key) else 0
