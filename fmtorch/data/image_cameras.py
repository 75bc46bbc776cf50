"""The focal length of a photograph in pixels, by what its camera wrote into the file (EXIF 2.32, JEITA CP-3451)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import ExifTags, Image

from fmtorch.data.colmap_model import read_cameras, read_model
from fmtorch.data.lenses import Lens
from fmtorch.data.text_files import DataError

FORMATS = ("JPEG", "PNG", "TIFF", "WEBP")
DIAGONAL_OF_35_MM = math.hypot(36, 24)  # mm
DEVIATION_OF_EQUIVALENT = 0.06  # relative: definitions by the diagonal and by the width, focus, stabilisation, crops
DEVIATION_OF_PLANE = 0.04  # relative: nominal focal length, focus
CROPPED = 0.02  # relative difference of the ratio of the sides from which on an image is not all that was recorded
MIN_FOCAL, MAX_FOCAL = 0.2, 50.0  # in units of the longer side, beyond which a focal length is taken for a mistake
MM_OF_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # of FocalPlaneResolutionUnit; the last two are not of the standard
Tags = Mapping[int, Any]
Tag = ExifTags.Base


class ExifFocal(NamedTuple):
    """The focal length of a photograph.

    focal: px, NaN where it is not known. deviation: its relative standard deviation, infinite where it is not known.
    source: the tags that it is from, or why it is not known.
    """

    focal: float
    deviation: float
    source: str

    @property
    def known(self) -> bool:
        """Whether there is a focal length."""
        return math.isfinite(self.focal)


def exif_focal(path: Path | str, size: tuple[int, int] | None = None) -> ExifFocal:
    """The focal length of a photograph in pixels, for square pixels, by its EXIF data.

    By FocalLengthIn35mmFilm where there is one: the focal length that gives a 36 x 24 mm film the same angle of view.
    CIPA DCG-001 takes that of the diagonal, and so does this: ``f = f35 diagonal / 43.27 mm``. By the width, as others
    have it, a 4:3 sensor would get 4 % less; at 3:2 both agree. Otherwise by FocalLength times FocalPlaneXResolution.

    Args:
        path: a JPEG, PNG, TIFF or WebP file. Only its header is read, and no damage to it raises an error.
        size: (h, w) of the image that the focal length is for, in either orientation, where it is not the file's: it
            was reduced, not cropped.

    Returns:
        The focal length, its relative deviation and its source. A whole number of millimetres is known to half of one,
        which the deviation includes. Not known, with the reason in `source`, where the file cannot be read or lacks the
        tags, where its sides are not in the ratio that the camera recorded (a crop), or where the number is absurd.
    """
    read = _read(Path(path))
    if isinstance(read, str):
        return _unknown(read)
    tags, stored = read
    sides = sorted(size or stored)
    recorded = sorted(value for tag in (Tag.ExifImageWidth, Tag.ExifImageHeight) if (value := _number(tags, tag)))
    if len(recorded) < 2:
        recorded = [float(side) for side in sorted(stored)]
    if abs(math.log(sides[1] / sides[0] * recorded[0] / recorded[1])) > CROPPED:
        shown, was = (f"{long:g} x {short:g}" for short, long in (sides, recorded))
        return _unknown(f"cropped: {shown} px, recorded as {was}")
    exif = _of_equivalent(tags, math.hypot(*sides)) or _of_plane(tags, sides[1] / recorded[1])
    if exif is None:
        return _unknown("no FocalLengthIn35mmFilm, and no FocalLength with FocalPlaneXResolution")
    if not MIN_FOCAL <= exif.focal / sides[1] <= MAX_FOCAL:
        return _unknown(f"{exif.source} give {exif.focal:.4g} px for an image of {sides[1]} px: a mistake")
    return exif


def _of_equivalent(tags: Tags, diagonal: float) -> ExifFocal | None:
    """By the focal length of a 35 mm film; diagonal: of the image, px."""
    equivalent = _number(tags, Tag.FocalLengthIn35mmFilm)
    if equivalent is None:
        return None
    rounding = 1 / math.sqrt(12) / equivalent if equivalent == round(equivalent) else 0.0
    deviation = math.hypot(DEVIATION_OF_EQUIVALENT, rounding)
    return ExifFocal(equivalent * diagonal / DIAGONAL_OF_35_MM, deviation, f"FocalLengthIn35mmFilm {equivalent:g} mm")


def _of_plane(tags: Tags, reduction: float) -> ExifFocal | None:
    """By the focal length of the lens and the pixels of the sensor; reduction: of the image that was recorded."""
    focal, across = (_number(tags, tag) for tag in (Tag.FocalLength, Tag.FocalPlaneXResolution))
    unit = MM_OF_UNIT.get(int(_number(tags, Tag.FocalPlaneResolutionUnit) or 2))
    if focal is None or across is None or unit is None or (_number(tags, Tag.DigitalZoomRatio) or 1) != 1:
        return None
    down = _number(tags, Tag.FocalPlaneYResolution) or across
    source = f"FocalLength {focal:g} mm, FocalPlaneXResolution {across / unit:g} px/mm"
    return ExifFocal(focal * math.sqrt(across * down) / unit * reduction, DEVIATION_OF_PLANE, source)


def _unknown(reason: str) -> ExifFocal:
    return ExifFocal(math.nan, math.inf, reason)


def _number(tags: Tags, tag: int) -> float | None:
    """The positive, finite number of a tag; None where there is none."""
    try:
        value = float(tags[tag])
    except (KeyError, TypeError, ValueError, ArithmeticError):
        return None
    return value if math.isfinite(value) and value > 0 else None


def _read(path: Path) -> tuple[dict[int, Any], tuple[int, int]] | str:
    """The EXIF tags of a file and its size (h, w), or why there are none."""
    try:
        with Image.open(path, formats=FORMATS) as image:
            tags = dict(image.getexif().get_ifd(ExifTags.IFD.Exif))
            return (tags, (image.height, image.width)) if tags else "no EXIF data"
    except OSError as error:
        return f"cannot be read ({error})"
    except Exception as error:  # Pillow raises what its parts do for damaged files
        return f"damaged EXIF data ({type(error).__name__}: {error})"


# Cameras of photographs by the photographs' names: of a COLMAP model, or of a JSON file


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
