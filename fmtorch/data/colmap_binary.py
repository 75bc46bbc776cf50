"""COLMAP models as binary files: cameras.bin and images.bin, little-endian."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.data.cameras import rotation_of_quaternion
from fmtorch.data.colmap_model import Model, ModelCamera, ModelImage, assembled, camera, expect_known
from fmtorch.data.lenses import MODELS
from fmtorch.data.text_files import DataError

_POINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_MAX_NAME = 4096  # bytes of a file name


class _Bytes:
    """A file's bytes, taken from its beginning on; running out of them names the record."""

    def __init__(self, path: Path) -> None:
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise DataError(
                f"{path}: cannot be read ({error.strerror}); it must be a file of a COLMAP model"
            ) from error
        self.path, self.at, self.record = path, 0, "its header"

    def take(self, count: int) -> bytes:
        """The next `count` bytes."""
        if count > len(self.data) - self.at:
            raise DataError(
                f"{self.path}: damaged or truncated, its {len(self.data)} bytes end within {self.record}; copy it again"
            )
        self.at += count
        return self.data[self.at - count : self.at]

    def unpack(self, form: str) -> tuple[Any, ...]:
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

    def expect_end(self) -> None:
        """Raises DataError where bytes are left."""
        if self.at != len(self.data):
            left = len(self.data) - self.at
            raise DataError(f"{self.path}: damaged, {left} bytes are left after {self.record}; copy it again")


def read_binary(folder: Path, points: bool = True) -> Model:
    """The model in a folder's binary files. points: keep which points each image sees."""
    files = (folder / "cameras.bin", folder / "images.bin")
    return assembled(_cameras(files[0]), _images(files[1], points), files)


def _cameras(path: Path) -> dict[int, ModelCamera]:
    data, cameras, names = _Bytes(path), {}, list(MODELS)
    (count,) = data.unpack("Q")
    for i in range(count):
        data.record = f"camera {i + 1} of {count}"
        key, model, width, height = data.unpack("iiQQ")
        place = f"{path}, {data.record}"
        expect_known(place, names[model] if 0 <= model < len(names) else f"number {model}")
        kind = MODELS[names[model]]
        parameters = np.array(data.unpack(f"{len(kind.parameters)}d"))
        cameras[key] = camera(place, names[model], width, height, parameters)
    data.expect_end()
    return cameras


def _images(path: Path, points: bool) -> list[ModelImage]:
    data, images = _Bytes(path), []
    (count,) = data.unpack("Q")
    for i in range(count):
        data.record = f"image {i + 1} of {count}"
        place = f"{path}, {data.record}"
        _, *pose, key = data.unpack("i7di")
        name = data.name()
        if not np.isfinite(pose).all():
            raise DataError(f"{place}: a pose that is not finite; the file is damaged, copy it again")
        R = rotation_of_quaternion(np.array(pose[:4]), place)
        (seen,) = data.unpack("Q")
        record = np.frombuffer(data.take(seen * _POINT.itemsize), _POINT)["point"]
        kept = record[record >= 0].astype(np.int64) if points else np.zeros(0, np.int64)
        images.append(ModelImage(name, key, R, np.array(pose[4:]), kept, place))
    data.expect_end()
    return images
