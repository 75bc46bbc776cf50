"""The cameras of photographs: of COLMAP models, of JSON files, and by what a camera wrote into its files (EXIF)."""

import dataclasses
import itertools
import json
import math
import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import ExifTags, Image

from fmtorch.core.lenses import MODELS, Lens
from fmtorch.data.files import DataError, Indices, Matrix, numbered, read_lines, to_finite, to_whole
from fmtorch.data.pairs import rotation_of_quaternion

HALF_PIXEL = 0.5  # COLMAP puts the centre of the first pixel at (0.5, 0.5)
_POINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_MAX_NAME = 4096  # bytes of a file name
_CAMERA = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."
_IMAGE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_POINTS = "a line of X Y POINT3D_ID for each point, which may be empty"
_Camera = tuple[str, int, str, int, int, Matrix]  # place, number, model, width, height, parameters


class ImageCamera(NamedTuple):
    """The lens of an image, None where it is unknown, with the origin at the centre of the first pixel.
    size: (h, w) of the image that it is of, where given."""

    lens: Lens | None
    size: tuple[int, int] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class ModelImage:
    """An image: R, t map world to camera; points: numbers of 3-D points seen. place: file and line, for messages."""

    name: str
    camera: int
    R: Matrix
    t: Matrix
    points: Indices
    place: str


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """A reconstruction: cameras by their numbers, images in the order of their names, and its two files."""

    cameras: dict[int, ImageCamera]
    images: list[ModelImage]
    files: tuple[Path, ...]


def read_model(folder: Path, points: bool = True) -> Model:
    """The model in a folder, of binary files where these are there, else of text files.
    points: read which points each image sees. Raises DataError, naming file and line or record, for damaged files."""
    suffix = next((suffix for suffix in (".bin", ".txt") if (folder / f"cameras{suffix}").is_file()), None)
    if suffix is None:
        raise DataError(f"{folder}: neither cameras.bin nor cameras.txt; it must hold a COLMAP model")
    files = (folder / f"cameras{suffix}", folder / f"images{suffix}")
    cameras, images = read_cameras(files[0]), dict[str, ModelImage]()
    for image in (_binary_images if suffix == ".bin" else _text_images)(files[1], points):
        if image.camera not in cameras:
            raise DataError(f"{image.place}: camera {image.camera} of {image.name} is not in {files[0].name}")
        if image.name in images:
            raise DataError(f"{image.place}: image {image.name} is already at {images[image.name].place}")
        images[image.name] = image
    if not images:
        raise DataError(f"{files[1]}: no image; a model must have some")
    return Model(cameras, sorted(images.values(), key=lambda image: image.name), files)


def read_cameras(path: Path) -> dict[int, ImageCamera]:
    """The cameras of a file cameras.txt or cameras.bin by their numbers. Raises DataError as `read_model`."""
    cameras: dict[int, ImageCamera] = {}
    records = (_binary_cameras if path.suffix == ".bin" else _text_cameras)(path)
    for place, number, model, width, height, parameters in records:
        if number in cameras:
            raise DataError(f"{place}: camera {number} stands twice")
        cameras[number] = _camera(place, model, width, height, parameters)
    return cameras


def _camera(place: str, model: str, width: int, height: int, parameters: Matrix) -> ImageCamera:
    """The camera of one record. Raises DataError for a model, size or numbers that no camera has."""
    kind = MODELS[model]
    names = kind.parameters
    if len(parameters) != len(names):
        raise DataError(f"{place}: {len(parameters)} parameters; {model} has {len(names)}: {', '.join(names)}")
    if width <= 0 or height <= 0:
        raise DataError(f"{place}: an image of {width} x {height} px; both sides must be positive")
    if not np.isfinite(parameters).all() or (parameters[: kind.focals] <= 0).any():
        raise DataError(f"{place}: {model} {parameters.tolist()}; focal lengths must be positive, all numbers finite")
    shifted = parameters.copy()
    shifted[kind.focals : kind.focals + 2] -= HALF_PIXEL
    return ImageCamera(kind.lens(model, shifted), (height, width))


def _image(place: str, pose: Matrix, camera: int, name: str, points: Indices) -> ModelImage:
    """The image of one record. pose: QW QX QY QZ TX TY TZ; points: numbers of 3-D points, -1 where there is none."""
    return ModelImage(name, camera, rotation_of_quaternion(pose[:4], place), pose[4:], points[points >= 0], place)


def _expect_known(place: str, model: str) -> None:
    if model not in MODELS:
        raise DataError(f"{place}: camera model {model} is not known here; there are {', '.join(MODELS)}")


def _text_cameras(path: Path) -> Iterator[_Camera]:
    lines = list(numbered(path))
    for number, line in lines:
        words, place = line.split(), f"{path}, line {number}"
        if len(words) < 4:
            raise DataError(f"{place}: {len(words)} columns; it must hold {_CAMERA}")
        _expect_known(place, words[1])
        key, width, height = (to_whole(path, number, words[i], _CAMERA.split()[i]) for i in (0, 2, 3))
        parameters = to_finite(path, number, words[4:], "the parameters of the camera", len(words) - 4)
        yield place, key, words[1], width, height, parameters
    _expect_announced(path, "cameras", len(lines))


def _text_images(path: Path, points: bool) -> Iterator[ModelImage]:
    """Two lines an image; the second may be empty, hence empty lines count after the first."""
    lines, count, at = read_lines(path), 0, 0
    while at < len(lines):
        if not lines[at].strip() or lines[at].startswith("#"):
            at += 1
            continue
        words, place = lines[at].split(maxsplit=9), f"{path}, line {at + 1}"
        if len(words) != 10:
            raise DataError(f"{place}: {len(words)} columns; it must hold {_IMAGE}, and the next line {_POINTS}")
        pose = to_finite(path, at + 1, words[1:8], "QW QX QY QZ TX TY TZ", 7)
        key = to_whole(path, at + 1, words[8], "CAMERA_ID")
        seen = lines[at + 1] if at + 1 < len(lines) else ""  # the last image's may have been an empty line
        yield _image(place, pose, key, words[9].strip(), _seen(path, at + 2, seen if points else ""))
        count, at = count + 1, at + 2
    _expect_announced(path, "images", count)


def _expect_announced(path: Path, what: str, count: int) -> None:
    """Raises DataError where there are fewer records than the comment says with which COLMAP begins its files."""
    for line in itertools.takewhile(lambda line: line.startswith("#"), read_lines(path)):
        announced = re.match(rf"# Number of {what}: (\d+)", line)
        if announced and count < int(announced[1]):
            contradiction = f"{count} {what}, but it announces {announced[1]}"
            raise DataError(f"{path}: {contradiction}: the file is truncated, copy it again")


def _seen(path: Path, number: int, line: str) -> Indices:
    words = line.split()
    if len(words) % 3:
        raise DataError(f"{path}, line {number}: {len(words)} columns; it must be {_POINTS}: is the file truncated?")
    try:
        return np.array([int(word) for word in words[2::3]], dtype=np.int64)
    except ValueError as error:
        raise DataError(f"{path}, line {number}: {error}; it must be {_POINTS}") from error


class _Records:
    """The records of a binary file, whose bytes are taken from its beginning on; running out of them names the one."""

    def __init__(self, path: Path, what: str) -> None:
        try:
            self.data = path.read_bytes()
        except OSError as error:
            problem = f"cannot be read ({error.strerror})"
            raise DataError(f"{path}: {problem}; it must be a file of a COLMAP model") from error
        self.path, self.what, self.at, self.record = path, what, 0, "its header"

    def places(self) -> Iterator[str]:
        """The place of each record, which is to be taken then. Raises DataError where bytes are left at the end."""
        (count,) = self.numbers("Q")
        for i in range(count):
            self.record = f"{self.what} {i + 1} of {count}"
            yield f"{self.path}, {self.record}"
        if self.at != len(self.data):
            left = len(self.data) - self.at
            raise DataError(f"{self.path}: damaged, {left} bytes are left after {self.record}; copy it again")

    def take(self, count: int) -> bytes:
        if count > len(self.data) - self.at:
            problem = f"damaged or truncated, its {len(self.data)} bytes end within {self.record}"
            raise DataError(f"{self.path}: {problem}; copy it again")
        self.at += count
        return self.data[self.at - count : self.at]

    def numbers(self, form: str) -> tuple[Any, ...]:
        """The next numbers, as `struct` calls their types."""
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))

    def name(self) -> str:
        """The next text, which ends in a zero byte."""
        end = self.data.find(b"\0", self.at, self.at + _MAX_NAME)
        text = self.take((end if end >= 0 else len(self.data) + 1) - self.at)
        self.at += 1
        try:
            return text.decode("utf-8")
        except UnicodeDecodeError as error:
            raise DataError(f"{self.path}: damaged, the name of {self.record} is no text; copy it again") from error


def _binary_cameras(path: Path) -> Iterator[_Camera]:
    records, names = _Records(path, "camera"), list(MODELS)
    for place in records.places():
        key, model, width, height = records.numbers("iiQQ")
        name = names[model] if 0 <= model < len(names) else f"number {model}"
        _expect_known(place, name)
        yield place, key, name, width, height, np.array(records.numbers(f"{len(MODELS[name].parameters)}d"))


def _binary_images(path: Path, points: bool) -> Iterator[ModelImage]:
    records = _Records(path, "image")
    for place in records.places():
        _, *pose, key = records.numbers("i7di")
        name = records.name()
        if not np.isfinite(pose).all():
            raise DataError(f"{place}: a pose that is not finite; the file is damaged, copy it again")
        (count,) = records.numbers("Q")
        seen = np.frombuffer(records.take(count * _POINT.itemsize), _POINT)["point"].astype(np.int64)
        yield _image(place, np.array(pose), key, name, seen if points else seen[:0])


# The focal length of a photograph in pixels, by what its camera wrote into the file (EXIF 2.32, JEITA CP-3451)

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
    source: the tags that it is from, or why it is not known."""

    focal: float
    deviation: float
    source: str

    @property
    def known(self) -> bool:
        return math.isfinite(self.focal)


def exif_focal(path: Path | str, size: tuple[int, int] | None = None) -> ExifFocal:
    """The focal length of a photograph in pixels, for square pixels, by its EXIF data.

    By FocalLengthIn35mmFilm where there is one: the focal length that gives a 36 x 24 mm film the same angle of view.
    CIPA DCG-001 takes that of the diagonal, and so does this: ``f = f35 diagonal / 43.27 mm``. By the width, as others
    have it, a 4:3 sensor would get 4 % less; at 3:2 both agree. Otherwise by FocalLength times FocalPlaneXResolution.

    Args:
        path: a JPEG, PNG, TIFF or WebP file. Only its header is read, and no damage to it raises an error.
        size: (h, w) of the image that it is for, in either orientation, where not the file's: reduced, not cropped.

    Returns:
        The focal length, its relative deviation and its source. A whole number of millimetres is known to half of one,
        which the deviation includes. Not known, with the reason in `source`, for an unreadable file, missing tags,
        another ratio of sides than was recorded (a crop) or an absurd number.
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
    try:
        value = float(tags[tag])
    except (KeyError, TypeError, ValueError, ArithmeticError):
        return None
    return value if math.isfinite(value) and value > 0 else None


def _read(path: Path) -> tuple[dict[int, Any], tuple[int, int]] | str:
    try:
        with Image.open(path, formats=FORMATS) as image:
            tags = dict(image.getexif().get_ifd(ExifTags.IFD.Exif))
            return (tags, (image.height, image.width)) if tags else "no EXIF data"
    except OSError as error:
        return f"cannot be read ({error})"
    except Exception as error:  # Pillow raises what its parts do for damaged files
        return f"damaged EXIF data ({type(error).__name__}: {error})"


FORM = '{"a.jpg": [fx, fy, cx, cy], "b.jpg": null}, in pixels with (0, 0) at the centre of the first one'
SHOWN = 5  # names that an error shows


class ImageCameras:
    """The cameras of a file, looked up by the paths of images.
    path: a COLMAP model, its folder or one of its files ``cameras.txt``, ``cameras.bin``; a ``cameras.txt`` without
    ``images.txt`` beside it, whose one camera is that of every image; or a JSON file of `FORM`.
    Raises DataError for a file that is missing or damaged, or holds something else."""

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
            self._all = cameras[0]
        else:
            model = read_model(path.parent if path.stem == "cameras" and path.is_file() else path, points=False)
            self._named = {image.name: model.cameras[image.camera] for image in model.images}

    def of(self, image: Path) -> ImageCamera:
        """The camera of an image, by the longest name that its path ends in. Raises DataError where there is none."""
        if self._all is not None:
            return self._all
        absolute = f"/{image.absolute().as_posix()}"
        names = [name for name in self._named if absolute.endswith(f"/{name}")]
        if not names:
            examples = ", ".join(sorted(self._named)[:SHOWN])
            known = f"those of {len(self._named)} images: {examples} ..."
            raise DataError(f"{self._path}: no camera of {image}; it has {known}")
        return self._named[max(names, key=len)]


def _of_json(path: Path) -> dict[str, ImageCamera]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: {error}; it must be a JSON file of {FORM}") from error
    if not isinstance(content, dict) or not content:
        raise DataError(f"{path}: it must be {FORM}")
    return {name: ImageCamera(None if K is None else pinhole(K, f"{path}, {name}")) for name, K in content.items()}


def pinhole(value: object, place: str) -> Lens:
    """The camera of [fx, fy, cx, cy]. Raises DataError, naming the place, for anything else."""
    numbers = value if isinstance(value, list) else []
    plain = len(numbers) == 4 and all(isinstance(number, int | float) for number in numbers)
    if not plain or not np.isfinite(numbers).all() or min(numbers[:2]) <= 0:
        raise DataError(f"{place}: {value!r}; it must be [fx, fy, cx, cy], finite, with positive focal lengths")
    fx, fy, cx, cy = map(float, numbers)
    return Lens(fx, fy, cx, cy)
