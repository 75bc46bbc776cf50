"""COLMAP models as text: cameras.txt and images.txt."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.cameras import rotation_of_quaternion
from fmtorch.data.colmap_model import Model, ModelCamera, ModelImage, assembled, camera, expect_known
from fmtorch.data.text_files import DataError, numbered, read_lines, to_finite, to_whole

_CAMERA = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."
_IMAGE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_POINTS = "a line of X Y POINT3D_ID for each point, which may be empty"


def read_text(folder: Path, points: bool = True) -> Model:
    """The model in a folder's text files. points: read which points each image sees."""
    files = (folder / "cameras.txt", folder / "images.txt")
    return assembled(read_cameras(files[0]), _images(files[1], points), files)


def read_cameras(path: Path) -> dict[int, ModelCamera]:
    """The cameras of a file cameras.txt by their numbers. Raises DataError, naming file and line."""
    cameras = {}
    for number, line in numbered(path):
        words, place = line.split(), f"{path}, line {number}"
        if len(words) < 4:
            raise DataError(f"{place}: {len(words)} columns; it must hold {_CAMERA}")
        expect_known(place, words[1])
        key, width, height = (to_whole(path, number, words[i], _CAMERA.split()[i]) for i in (0, 2, 3))
        parameters = to_finite(path, number, words[4:], "the parameters of the camera", len(words) - 4)
        if key in cameras:
            raise DataError(f"{place}: camera {key} stands twice")
        cameras[key] = camera(place, words[1], width, height, parameters)
    _expect_announced(path, "cameras", len(cameras))
    return cameras


def _images(path: Path, points: bool) -> list[ModelImage]:
    """Two lines an image; the second may be empty, hence empty lines count after the first."""
    lines, images, at = read_lines(path), list[ModelImage](), 0
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
        numbers = _seen(path, at + 2, seen) if points else np.zeros(0, np.int64)
        R = rotation_of_quaternion(pose[:4], place)
        images.append(ModelImage(words[9].strip(), key, R, pose[4:], numbers, place))
        at += 2
    _expect_announced(path, "images", len(images))
    return images


def _expect_announced(path: Path, what: str, count: int) -> None:
    """Raises DataError where there are fewer records than the comment says with which COLMAP begins its files."""
    for line in itertools.takewhile(lambda line: line.startswith("#"), read_lines(path)):
        announced = re.match(rf"# Number of {what}: (\d+)", line)
        if announced and count < int(announced[1]):
            raise DataError(
                f"{path}: {count} {what}, but it announces {announced[1]}: the file is truncated, copy it again"
            )


def _seen(path: Path, number: int, line: str) -> NDArray[np.int64]:
    """The numbers of the 3-D points of a line of points; -1 stands for a point without one."""
    words = line.split()
    if len(words) % 3:
        raise DataError(f"{path}, line {number}: {len(words)} columns; it must be {_POINTS}: is the file truncated?")
    try:
        numbers = np.array([int(word) for word in words[2::3]], dtype=np.int64)
    except ValueError as error:
        raise DataError(f"{path}, line {number}: {error}; it must be {_POINTS}") from error
    return numbers[numbers >= 0]
