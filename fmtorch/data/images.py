"""Images from disk, exactly as OpenCV decodes them, and never a half-decoded one."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.data.pairs import ImageSource

_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_JPEG_MARKER = re.compile(rb"\xff+([^\x00\xff\xd0-\xd7])", re.DOTALL)
_END_OF_IMAGE, _START_OF_IMAGE = 0xD9, 0xD8


class ImageError(ValueError):
    """An image file that cannot be used; the message names the file and what would be right."""


def read_image(source: ImageSource | Path | str, *, orient: bool = False) -> NDArray[np.uint8]:
    """The image at `source` as uint8, (H, W) when the file is grey and RGB (H, W, 3) when it has colour.

    Any format OpenCV decodes; 16 bits are reduced to 8, transparency is dropped.
    orient: turn the image as its EXIF orientation says. Off by default: ground truth is given for the pixels as stored.
    Raises ImageError for a file that is missing, empty, truncated, corrupt or no image: OpenCV alone fills the
    missing part of a truncated file with grey and says nothing.
    """
    path = source.path if isinstance(source, ImageSource) else Path(source)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror}); it must be an image file") from error
    if not data:
        raise ImageError(f"{path}: the file is empty; it must be a complete image")
    _expect_complete(path, data)
    flags = cv2.IMREAD_ANYCOLOR | (0 if orient else cv2.IMREAD_IGNORE_ORIENTATION)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ImageError(f"{path}: OpenCV refuses it ({error}); it must be a sound image") from error
    if image is None:
        raise ImageError(f"{path}: no image that OpenCV can decode; it must be JPEG, PNG, TIFF or WebP")
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)  # type: ignore[return-value]


def to_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey levels (H, W) of a grey or RGB image, with OpenCV's weights and rounding (its BGR2GRAY)."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)  # type: ignore[return-value]


def _expect_complete(path: Path, data: bytes) -> None:
    """Raises ImageError for a JPEG or PNG whose structure does not reach its end."""
    if data.startswith(_JPEG) and not _jpeg_ends(data):
        raise ImageError(f"{path}: truncated JPEG, {len(data)} bytes without end-of-image marker; copy it again")
    if data.startswith(_PNG):
        fault = _png_fault(data)
        if fault:
            raise ImageError(f"{path}: {fault}; copy it again")


def _jpeg_ends(data: bytes) -> bool:
    """Whether the markers of a JPEG lead to its end-of-image marker (ITU-T T.81, annex B)."""
    position = 2
    while found := _JPEG_MARKER.search(data, position):
        marker = found[1][0]
        position = found.end()
        if marker == _END_OF_IMAGE:
            return True
        if marker == 0x01 or marker == _START_OF_IMAGE:  # markers without a length
            continue
        position += int.from_bytes(data[position : position + 2], "big")
    return False


def _png_fault(data: bytes) -> str:
    """What is wrong with a PNG's chunks, empty when they are sound up to IEND (PNG specification, section 5)."""
    position = len(_PNG)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        kind, end = data[position + 4 : position + 8], position + 12 + length
        if end > len(data):
            break
        if zlib.crc32(data[position + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return f"corrupt PNG, wrong checksum of chunk {kind.decode('latin-1')} at byte {position}"
        if kind == b"IEND":
            return ""
        position = end
    return f"truncated PNG, {len(data)} bytes without IEND chunk"
