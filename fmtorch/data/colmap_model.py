"""What of a COLMAP model concerns image pairs: its cameras and images, read from text or binary files.

Format: COLMAP's documentation, "Output Format". Rigs and frames, which newer versions write beside, repeat the poses.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.cameras import Matrix
from fmtorch.data.lenses import MODELS, Lens
from fmtorch.data.text_files import DataError

HALF_PIXEL = 0.5  # COLMAP puts the centre of the first pixel at (0.5, 0.5)


@dataclasses.dataclass(frozen=True)
class ModelCamera:
    """A camera: its lens, with the origin at the centre of the first pixel, and the size (h, w) of its images."""

    lens: Lens
    size: tuple[int, int]


@dataclasses.dataclass(frozen=True, eq=False)
class ModelImage:
    """An image: R, t map the world to the camera; points are the numbers of the 3-D points that it sees."""

    name: str
    camera: int
    R: Matrix
    t: Matrix
    points: NDArray[np.int64]
    place: str


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """A reconstruction: cameras by their numbers, images in the order of their names, and its two files."""

    cameras: dict[int, ModelCamera]
    images: list[ModelImage]
    files: tuple[Path, ...]


def camera(place: str, model: str, width: int, height: int, parameters: NDArray[np.float64]) -> ModelCamera:
    """The camera of one record. Raises DataError, after `place`, for a size, or numbers, that no camera has."""
    kind = MODELS[model]
    names = kind.parameters
    if len(parameters) != len(names):
        raise DataError(f"{place}: {len(parameters)} parameters; {model} has {len(names)}: {', '.join(names)}")
    if width <= 0 or height <= 0:
        raise DataError(f"{place}: an image of {width} x {height} px; both sides must be positive")
    if not np.isfinite(parameters).all() or (parameters[: kind.focals] <= 0).any():
        raise DataError(f"{place}: {model} {parameters.tolist()}; focal lengths must be positive, all numbers finite")
    shifted = parameters.astype(np.float64, copy=True)
    shifted[kind.focals : kind.focals + 2] -= HALF_PIXEL
    return ModelCamera(kind.lens(model, shifted), (height, width))


def expect_known(place: str, model: str) -> None:
    """Raises DataError, after `place`, unless a camera model is one that a pinhole image can be made of."""
    if model not in MODELS:
        raise DataError(f"{place}: camera model {model} is not known here; there are {', '.join(MODELS)}")


def assembled(cameras: dict[int, ModelCamera], images: list[ModelImage], files: tuple[Path, ...]) -> Model:
    """The model of its records. Raises DataError where an image has no camera, or a name stands twice."""
    names: dict[str, ModelImage] = {}
    for image in images:
        if image.camera not in cameras:
            raise DataError(f"{image.place}: camera {image.camera} of {image.name} is not in {files[0].name}")
        if image.name in names:
            raise DataError(f"{image.place}: image {image.name} is already at {names[image.name].place}")
        names[image.name] = image
    if not images:
        raise DataError(f"{files[1]}: no image; a model must have some")
    return Model(cameras, sorted(images, key=lambda image: image.name), files)
