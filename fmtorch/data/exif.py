"""The focal length of a photograph in pixels, by what its camera wrote into the file (EXIF 2.32, JEITA CP-3451)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from PIL import ExifTags, Image

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
