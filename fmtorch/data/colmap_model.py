"""COLMAP models, text or binary: what of them concerns image pairs, the cameras and images.

Format: COLMAP's documentation, "Output Format"; binary files are little-endian. Rigs and frames, which newer versions
write beside, repeat the poses.

pycolmap 4.2 reads them too, and is what the tests hold this reader to. It takes a file that was cut for a whole one,
ends the names of a text file at their first blank, needs points3D, and names no file in its errors: not so here.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.cameras import Matrix, rotation_of_quaternion
from fmtorch.data.lenses import MODELS, Lens
from fmtorch.data.text_files import DataError, numbered, read_lines, to_finite, to_whole

HALF_PIXEL = 0.5  # COLMAP puts the centre of the first pixel at (0.5, 0.5)
_POINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_MAX_NAME = 4096  # bytes of a file name
_CAMERA = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."
_IMAGE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_POINTS = "a line of X Y POINT3D_ID for each point, which may be empty"


@dataclasses.dataclass(frozen=True)
class ModelCamera:
    """A camera: its lens, with the origin at the centre of the first pixel, and the size (h, w) of its images."""

    lens: Lens
    size: tuple[int, int]


@dataclasses.dataclass(frozen=True, eq=False)
class ModelImage:
    """An image: R, t map the world to the camera; points are the numbers of the 3-D points that it sees.

    place: file and line, or record, with which messages begin.
    """

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


class _CameraRecord(NamedTuple):
    place: str
    number: int
    model: str
    width: int
    height: int
    parameters: Matrix


class _ImageRecord(NamedTuple):
    """pose: QW QX QY QZ TX TY TZ; points: the numbers of 3-D points, -1 where there is none."""

    place: str
    pose: Matrix
    camera: int
    name: str
    points: NDArray[np.int64]


def read_model(folder: Path, points: bool = True) -> Model:
    """The model in a folder, of binary files where these are there, else of text files.

    points: read which points each image sees. Raises DataError, naming file and line or record, for damaged files.
    """
    suffix = next((suffix for suffix in (".bin", ".txt") if (folder / f"cameras{suffix}").is_file()), None)
    if suffix is None:
        raise DataError(f"{folder}: neither cameras.bin nor cameras.txt; it must hold a COLMAP model")
    files = (folder / f"cameras{suffix}", folder / f"images{suffix}")
    cameras, images = read_cameras(files[0]), dict[str, ModelImage]()
    for place, pose, camera, name, seen in (_binary_images if suffix == ".bin" else _text_images)(files[1], points):
        R = rotation_of_quaternion(pose[:4], place)
        if camera not in cameras:
            raise DataError(f"{place}: camera {camera} of {name} is not in {files[0].name}")
        if name in images:
            raise DataError(f"{place}: image {name} is already at {images[name].place}")
        images[name] = ModelImage(name, camera, R, pose[4:], seen[seen >= 0], place)
    if not images:
        raise DataError(f"{files[1]}: no image; a model must have some")
    return Model(cameras, sorted(images.values(), key=lambda image: image.name), files)


def read_cameras(path: Path) -> dict[int, ModelCamera]:
    """The cameras of a file cameras.txt or cameras.bin by their numbers. Raises DataError as `read_model`."""
    cameras: dict[int, ModelCamera] = {}
    for record in (_binary_cameras if path.suffix == ".bin" else _text_cameras)(path):
        if record.number in cameras:
            raise DataError(f"{record.place}: camera {record.number} stands twice")
        cameras[record.number] = _camera(record)
    return cameras


def _camera(record: _CameraRecord) -> ModelCamera:
    """The camera of one record. Raises DataError for a model, size or numbers that no camera has."""
    place, _, model, width, height, parameters = record
    _expect_known(place, model)
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
    return ModelCamera(kind.lens(model, shifted), (height, width))


def _expect_known(place: str, model: str) -> None:
    if model not in MODELS:
        raise DataError(f"{place}: camera model {model} is not known here; there are {', '.join(MODELS)}")


def _text_cameras(path: Path) -> Iterator[_CameraRecord]:
    lines = list(numbered(path))
    for number, line in lines:
        words, place = line.split(), f"{path}, line {number}"
        if len(words) < 4:
            raise DataError(f"{place}: {len(words)} columns; it must hold {_CAMERA}")
        _expect_known(place, words[1])
        key, width, height = (to_whole(path, number, words[i], _CAMERA.split()[i]) for i in (0, 2, 3))
        parameters = to_finite(path, number, words[4:], "the parameters of the camera", len(words) - 4)
        yield _CameraRecord(place, key, words[1], width, height, parameters)
    _expect_announced(path, "cameras", len(lines))


def _text_images(path: Path, points: bool) -> Iterator[_ImageRecord]:
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
        yield _ImageRecord(place, pose, key, words[9].strip(), _seen(path, at + 2, seen if points else ""))
        count, at = count + 1, at + 2
    _expect_announced(path, "images", count)


def _expect_announced(path: Path, what: str, count: int) -> None:
    """Raises DataError where there are fewer records than the comment says with which COLMAP begins its files."""
    for line in itertools.takewhile(lambda line: line.startswith("#"), read_lines(path)):
        announced = re.match(rf"# Number of {what}: (\d+)", line)
        if announced and count < int(announced[1]):
            raise DataError(
                f"{path}: {count} {what}, but it announces {announced[1]}: the file is truncated, copy it again"
            )


def _seen(path: Path, number: int, line: str) -> NDArray[np.int64]:
    """The numbers of the 3-D points of a line of points."""
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
            raise DataError(
                f"{path}: cannot be read ({error.strerror}); it must be a file of a COLMAP model"
            ) from error
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
        """The next `count` bytes."""
        if count > len(self.data) - self.at:
            raise DataError(
                f"{self.path}: damaged or truncated, its {len(self.data)} bytes end within {self.record}; copy it again"
            )
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


def _binary_cameras(path: Path) -> Iterator[_CameraRecord]:
    records, names = _Records(path, "camera"), list(MODELS)
    for place in records.places():
        key, model, width, height = records.numbers("iiQQ")
        name = names[model] if 0 <= model < len(names) else f"number {model}"
        _expect_known(place, name)
        parameters = np.array(records.numbers(f"{len(MODELS[name].parameters)}d"))
        yield _CameraRecord(place, key, name, width, height, parameters)


def _binary_images(path: Path, points: bool) -> Iterator[_ImageRecord]:
    records = _Records(path, "image")
    for place in records.places():
        _, *pose, key = records.numbers("i7di")
        name = records.name()
        if not np.isfinite(pose).all():
            raise DataError(f"{place}: a pose that is not finite; the file is damaged, copy it again")
        (count,) = records.numbers("Q")
        seen = np.frombuffer(records.take(count * _POINT.itemsize), _POINT)["point"].astype(np.int64)
        yield _ImageRecord(place, np.array(pose), key, name, seen if points else seen[:0])
