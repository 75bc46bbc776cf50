"""Images from disk: never a half-decoded one, turned only on demand, and their sizes from headers alone."""

import contextlib
import io
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import kornia_rs
import numpy as np
from PIL import ExifTags, Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin

from fmtorch.data.files import Array, Pixels
from fmtorch.data.pairs import ImageSource, undistorted

_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_TIFF = (b"II*\0", b"II+\0", b"MM\0*", b"MM\0+")  # the second of each order: BigTIFF
_JPEG_MARKER = re.compile(rb"\xff+([^\x00\xff\xd0-\xd7])", re.DOTALL)
_END_OF_IMAGE, _START_OF_IMAGE = 0xD9, 0xD8
_HUFFMAN_FRAMES = (0xC0, 0xC1, 0xC2)  # baseline, extended sequential, progressive
_set_log_level, _SILENT = getattr(cv2.utils, "logging", cv2).setLogLevel, 0  # of OpenCV 5, of OpenCV 4

MAX_PIXELS = 2**28  # by the header: a few kilobytes may claim gigabytes; the largest sensors have 2e8


class ImageError(ValueError):
    """An image file that cannot be used; the message names the file and what would be right."""


FORMATS = "JPEG, PNG, TIFF, WebP, AVIF, BMP, GIF, JPEG 2000, PNM, PFM, Radiance HDR, or HEIC with pillow-heif"
"""What `read_image` reads."""


def read_image(source: ImageSource | Path | str, *, orient: bool = False) -> Pixels:
    """The image at `source` as uint8, (H, W) when the file is grey and RGB (H, W, 3) when it has colour.

    Any of `FORMATS`, of an animation the first frame. Values of more than 8 bits and floats are scaled so that the
    image's own range becomes 0 to 255, not finite ones become 0; transparency is dropped.
    An `ImageSource` with a lens gives the undistorted image (`undistorted`), one with a resampling that of it.

    Args:
        source: the file.
        orient: turn the image as its EXIF orientation, TIFF tag or AVIF's rotation says. Off by default: ground truth
            is given for the pixels as stored. HEIC is always upright, as its standard demands.

    Raises:
        ImageError: for a file that is missing, empty, truncated, corrupt, no image, of more than `MAX_PIXELS`, or of
            another size than its source says: OpenCV alone makes up what is missing or damaged.
    """
    if not isinstance(source, ImageSource):
        return _decoded(Path(source), orient)
    image = _decoded(source.path, orient, source.data)
    if source.size is not None and image.shape[:2] != source.size:
        (h, w), (height, width) = image.shape[:2], source.size
        sizes = f"{w} x {h} px, but its camera is of {width} x {height} px"
        raise ImageError(f"{source.path}: {sizes}; it must be the image as it was when its camera was determined")
    image = image if source.lens is None or source.as_photographed else undistorted(image, source.lens)
    return image if source.resampling is None else source.resampling(image)


def stored_size(path: Path) -> tuple[int, int] | None:
    """(h, w) of an image file, in pixels as stored; None where there is none, or no header that tells."""
    try:
        with Image.open(path) as image:
            if isinstance(image, TiffImagePlugin.TiffImageFile):  # its width and height are those after turning
                return int(image.tag_v2[TiffImagePlugin.IMAGELENGTH]), int(image.tag_v2[TiffImagePlugin.IMAGEWIDTH])
            return image.height, image.width
    except (OSError, ValueError, KeyError, Image.DecompressionBombError):
        return None


def stored_orientation(file: Path | io.BytesIO) -> int:
    """How an image file is to be turned to be upright, 1 (not at all) to 8 as in EXIF; 1 where it does not tell."""
    with contextlib.suppress(Exception):  # damaged tags raise nearly anything
        data = np.memmap(file, mode="r").data if isinstance(file, Path) else file.getbuffer()
        if data[:4] in _TIFF:
            return _tiff_orientation(data)[0]
        with Image.open(file) as image:
            value = image.getexif().get(ExifTags.Base.Orientation, 1)
            return value if value in _TURNS else 1
    return 1


_TURNS = {1: (1, 1), 2: (1, -1), 3: (-1, -1), 4: (-1, 1), 5: (1, 1), 6: (-1, 1), 7: (-1, -1), 8: (1, -1)}
"""By EXIF's Orientation (JEITA CP-3451, 4.6.4): steps along rows and columns, which are exchanged then from 5 on."""


def _tiff_orientation(data: bytes | memoryview) -> tuple[int, slice, bytes]:
    """What `stored_orientation` tells of a TIFF file (TIFF 6.0, section 2), where, and what 1 is there.
    Pillow opens not all kinds; OpenCV turns all of these, tile by tile those of tiles with 8 bits."""
    order = -1 if data[:1] == b"I" else 1  # of bytes, by that of the largest one first
    width, step, offset = (8, 20, 8) if data[:4] in _TIFF[1::2] else (2, 12, 4)

    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size][::order], "big")  # 0 beyond the end

    first = number(offset, offset) + width
    for at in range(first, first + step * min(number(first - width, width), 2**16), step):
        if number(at, 2) == ExifTags.Base.Orientation:
            size, place = (2 if number(at + 2, 2) == 3 else 4), at + step - offset
            value = number(place, size)
            return (value if value in _TURNS else 1), slice(place, place + size), (1).to_bytes(size, "big")[::order]
    return 1, slice(0, 0), b""


def _decoded(path: Path, orient: bool, data: bytes | None = None) -> Pixels:
    try:
        if data is None and path.exists() and not (path.is_file() or path.is_dir()):  # a pipe waits, a device too
            raise ImageError(f"{path}: no regular file; it must be an image file")
        data = path.read_bytes() if data is None else data
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror}); it must be an image file") from error
    if not data:
        raise ImageError(f"{path}: the file is empty; it must be a complete image")
    if data.startswith(_JPEG) and all(marker != _END_OF_IMAGE for marker, _ in _jpeg_segments(data)):
        raise ImageError(f"{path}: truncated JPEG, {len(data)} bytes without end-of-image marker; copy it again")
    if data.startswith(_PNG):
        try:
            PngImagePlugin.PngImageFile(io.BytesIO(data)).verify()  # the checksums of all chunks
        except Exception as error:  # Pillow raises what its parts do for damaged files
            raise ImageError(f"{path}: corrupt or truncated PNG ({error}); copy it again") from error
    _expect_moderate(path, data)
    orientation = stored_orientation(io.BytesIO(data)) if orient and not _is_heic(data) else 1
    if data[:4] in _TIFF:
        place, upright = _tiff_orientation(data)[1:]
        data = data[: place.start] + upright + data[place.stop :]  # nothing for OpenCV to turn
    image = _eight_bits(path, _heic(path, data) if _is_heic(data) else _by_opencv(path, data))
    if data.startswith(_JPEG) and not _jpeg_decodes(data):
        raise ImageError(f"{path}: corrupt JPEG, its compressed data are damaged; copy it again")
    rows, columns = _TURNS[orientation]
    turned = image[::rows, ::columns]
    return np.ascontiguousarray(turned.swapaxes(0, 1) if orientation >= 5 else turned)


def _by_opencv(path: Path, data: bytes) -> Array:
    """The pixels, of any depth, grey or RGB; a TIFF file with an orientation is turned."""
    deep = 0 if data[4:8] == b"ftyp" else cv2.IMREAD_ANYDEPTH  # 10 bits of an AVIF are a photograph's
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION | deep
    level = _set_log_level(_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ImageError(f"{path}: OpenCV refuses it ({error.err}); it must be a sound image") from error
    finally:
        if level != _SILENT:  # as another thread may have set it
            _set_log_level(level)
    if image is None:
        right = "a sound TIFF of 8 or 16 bits or float32, best in strips" if data[:4] in _TIFF else FORMATS
        raise ImageError(f"{path}: no image that can be decoded; it must be {right}")
    return image if image.ndim == 2 else image[..., ::-1]


def _is_heic(data: bytes) -> bool:
    brands = data[8 : int.from_bytes(data[:4], "big")] if data[4:8] == b"ftyp" else b""
    return any(brands[i : i + 4] in (b"heic", b"heix", b"heim", b"heis", b"hevc") for i in range(0, len(brands), 4))


def _heic(path: Path, data: bytes) -> Array:
    try:
        import pillow_heif
    except ImportError as error:
        raise ImageError(f"{path}: a HEIC image; pip install pillow-heif reads it, or convert it to JPEG") from error
    try:
        image = pillow_heif.open_heif(io.BytesIO(data)).to_pillow()
    except Exception as error:  # of libheif
        raise ImageError(f"{path}: pillow-heif refuses it ({error}); it must be a sound image") from error
    return np.asarray(image if image.mode == "L" else image.convert("RGB"))


def _eight_bits(path: Path, image: Array) -> Pixels:
    if image.dtype == np.uint8:
        return image
    values = image.astype(np.float64)
    known = np.isfinite(values)
    if not known.any():
        raise ImageError(f"{path}: none of its values is a finite number; it must be an image")
    values *= 2.0 ** -np.clip(np.frexp(np.abs(values[known]).max())[1], -1000, 1000)  # whose differences are finite
    low, high = values[known].min(), values[known].max()
    scaled = np.where(known, values - low, 0) * float(255 / (high - low) if high > low else 0)
    return np.rint(scaled).astype(np.uint8)


def to_grey(image: Pixels) -> Pixels:
    """Grey levels (H, W) of a grey or RGB image, with OpenCV's weights and rounding (its BGR2GRAY)."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)  # type: ignore[return-value]


def _expect_moderate(path: Path, data: bytes) -> None:
    opened: Callable[[io.BytesIO], Image.Image] = Image.open  # with a limit of its own, 1.8e8 pixels
    if data.startswith((_JPEG, _PNG)):
        opened = JpegImagePlugin.JpegImageFile if data.startswith(_JPEG) else PngImagePlugin.PngImageFile
    try:
        width, height = opened(io.BytesIO(data)).size
    except Image.DecompressionBombError as error:
        raise ImageError(f"{path}: {error}; it must have fewer pixels, reduce it") from error
    except Exception:  # what is no image to Pillow may be one to OpenCV, which is asked next
        return
    if width * height > MAX_PIXELS:
        raise ImageError(f"{path}: {width} x {height} px; it must have at most {MAX_PIXELS} pixels, reduce it")


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """The markers of a JPEG up to its end-of-image marker, and where what follows each begins (ITU-T T.81, annex B)."""
    position = 2
    while match := _JPEG_MARKER.search(data, position):
        marker = match[1][0]
        position = match.end()
        yield marker, position
        if marker == _END_OF_IMAGE:
            return
        if marker not in (0x01, _START_OF_IMAGE):  # markers without a length
            position += int.from_bytes(data[position : position + 2], "big")


def _jpeg_decodes(data: bytes) -> bool:
    """Whether a JPEG decodes without a warning of libjpeg, which TurboJPEG takes for an error.
    True where it does not tell: for other frames than grey or of three components, of 8 bits, coded in a usual way."""
    frame = next((data[at : at + 8] for marker, at in _jpeg_segments(data) if marker in _HUFFMAN_FRAMES), b"")
    if len(frame) < 8 or frame[2] != 8 or frame[7] not in (1, 3):
        return True
    decoder = kornia_rs.io.ImageDecoder()
    try:
        decoder.read_header(data)
    except Exception:  # the library knows no other; a form of JPEG that it does not take
        return True
    try:
        decoder.decode(data)
    except Exception:
        return False
    return True
