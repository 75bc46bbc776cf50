"""Cameras of photographs by the photographs' names: of a COLMAP model, or of a JSON file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmtorch.data.colmap_model import read_cameras, read_model
from fmtorch.data.lenses import Lens
from fmtorch.data.text_files import DataError

FORM = '{"a.jpg": [fx, fy, cx, cy], "b.jpg": null}, in pixels with (0, 0) at the centre of the first one'
SHOWN = 5  # names that an error shows


class ImageCamera(NamedTuple):
    """The lens of an image, None where it is unknown, and the size (h, w) of the image that it is of, where given."""

    lens: Lens | None
    size: tuple[int, int] | None = None


class ImageCameras:
    """The cameras of a file, looked up by the paths of images.

    Args:
        path: a COLMAP model, its folder or one of its files ``cameras.txt``, ``cameras.bin``; a ``cameras.txt`` without
            ``images.txt`` beside it, whose one camera is that of every image; or a JSON file of `FORM`.

    Raises:
        DataError: for a file that is missing or damaged, or holds something else.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._all: ImageCamera | None = None
        self._named: Mapping[str, ImageCamera] = {}
        if path.suffix == ".json":
            self._named = _of_json(path)
        elif path.name == "cameras.txt" and not (path.parent / "images.txt").exists():
            cameras = list(read_cameras(path).values())
            if len(cameras) != 1:
                raise DataError(f"{path}: {len(cameras)} cameras and no images.txt beside it that says whose they are")
            self._all = ImageCamera(cameras[0].lens, cameras[0].size)
        else:
            model = read_model(path if path.is_dir() else path.parent, points=False)
            by_number = {number: ImageCamera(camera.lens, camera.size) for number, camera in model.cameras.items()}
            self._named = {image.name: by_number[image.camera] for image in model.images}

    def of(self, image: Path) -> ImageCamera:
        """The camera of an image, by the longest name that its path ends in. Raises DataError where there is none."""
        if self._all is not None:
            return self._all
        absolute = f"/{image.absolute().as_posix()}"
        names = [name for name in self._named if absolute.endswith(f"/{name}")]
        if not names:
            examples = ", ".join(sorted(self._named)[:SHOWN])
            raise DataError(
                f"{self._path}: no camera of {image}; it has those of {len(self._named)} images: {examples} ..."
            )
        return self._named[max(names, key=len)]


def _of_json(path: Path) -> dict[str, ImageCamera]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: {error}; it must be a JSON file of {FORM}") from error
    if not isinstance(content, dict) or not content:
        raise DataError(f"{path}: it must be {FORM}")
    return {
        name: ImageCamera(None if value is None else _lens(value, f"{path}, {name}")) for name, value in content.items()
    }


def _lens(value: object, place: str) -> Lens:
    """The camera of fx, fy, cx, cy."""
    numbers = value if isinstance(value, list) else []
    plain = len(numbers) == 4 and all(isinstance(number, int | float) for number in numbers)
    if not plain or not np.isfinite(numbers).all() or min(numbers[:2]) <= 0:
        raise DataError(f"{place}: {value!r}; it must be [fx, fy, cx, cy], finite, with positive focal lengths")
    fx, fy, cx, cy = map(float, numbers)
    return Lens(fx, fy, cx, cy)
