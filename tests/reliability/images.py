"""Image files that are damaged, rare or hostile, made from nothing but the formats' definitions and Pillow."""

import functools
import io
import struct
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np
from PIL import Image

SOFT = cv2.resize(np.random.default_rng(0).uniform(0, 255, (12, 16, 3)), (160, 120)).clip(0, 255).astype(np.uint8)


def saved(picture: Any, form: str, **options: Any) -> bytes:
    """A picture of Pillow, or an array, as a file of that format."""
    stream = io.BytesIO()
    picture = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
    picture.save(stream, form, **options)
    return stream.getvalue()


def pages(picture: np.ndarray, form: str, **options: Any) -> bytes:
    """Several pages or frames, of which the picture is the first."""
    rest = [Image.fromarray(255 - picture)]
    return saved(picture, form, save_all=True, append_images=rest, **options)


def png(width: int, height: int, rows: bytes, colour: int = 0, depth: int = 8, packed: bytes = b"") -> bytes:
    """A PNG by its specification: a header of any size over any rows, or over those that are compressed already."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    written = b"\x89PNG\r\n\x1a\n"
    for kind, data in ((b"IHDR", header), (b"IDAT", packed or zlib.compress(rows, 9)), (b"IEND", b"")):
        written += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return written


def jpeg_of_size(width: int, height: int) -> bytes:
    data = bytearray(saved(SOFT, "JPEG"))
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def half(form: str) -> bytes:
    """The first half of a sound file; of a TIFF by OpenCV, whose rows are compressed."""
    form = "" if form == "tiff" else Image.registered_extensions()[f".{form}"]
    data = saved(SOFT, form) if form else bytes(cv2.imencode(".tiff", SOFT)[1])
    return data[: len(data) // 2]


def bomb(side: int) -> bytes:
    """A sound PNG of side x side black pixels in some hundredth of the bytes; side: thousands."""
    packer = zlib.compressobj(1)
    rows = bytes((1 + side) * 1000)
    idat = b"".join(packer.compress(rows) for _ in range(side // 1000)) + packer.flush()
    return png(side, side, b"", packed=idat)


GREY = SOFT[..., 0]
SOUND: Mapping[str, Callable[[], bytes]] = {
    "cmyk.jpg": lambda: saved(Image.fromarray(SOFT).convert("CMYK"), "JPEG"),
    "ycck.jpg": lambda: saved(Image.fromarray(SOFT).convert("CMYK"), "JPEG", quality=100),
    "progressive.jpg": lambda: saved(SOFT, "JPEG", progressive=True, subsampling=0),
    "411.jpg": lambda: saved(SOFT, "JPEG", subsampling="4:1:1"),
    "grey.jpg": lambda: saved(GREY, "JPEG"),
    "16 bit.png": lambda: bytes(cv2.imencode(".png", SOFT.astype(np.uint16) * 257)[1]),
    "16 bit grey.png": lambda: bytes(cv2.imencode(".png", GREY.astype(np.uint16) * 257)[1]),
    "16 bit.tiff": lambda: bytes(cv2.imencode(".tiff", GREY.astype(np.uint16) * 257)[1]),
    "1 bit.png": lambda: saved(Image.fromarray(GREY).convert("1"), "PNG"),
    "palette.png": lambda: saved(Image.fromarray(SOFT).convert("P"), "PNG"),
    "grey and alpha.png": lambda: saved(Image.fromarray(SOFT).convert("LA"), "PNG"),
    "alpha.webp": lambda: saved(Image.fromarray(SOFT).convert("RGBA"), "WEBP", lossless=True),
    "interlaced.png": lambda: bytes(cv2.imencode(".png", SOFT)[1]),
    "bitmap.bmp": lambda: saved(SOFT, "BMP"),
    "one pixel.png": lambda: saved(SOFT[:1, :1], "PNG"),
    "one column.png": lambda: saved(SOFT[:, :1], "PNG"),
    "65535 px.png": lambda: png(65_535, 2, (b"\0" + bytes(range(255)) * 257) * 2),
    "65535 px.jpg": lambda: bytes(cv2.imencode(".jpg", np.tile(GREY[:8], (1, 410))[:, :65_500])[1]),
    "JPEG named.png": lambda: saved(SOFT, "JPEG"),
    "PNG named.jpg": lambda: saved(SOFT, "PNG"),
    "animated.gif": lambda: pages(GREY, "GIF"),
    "animated.webp": lambda: pages(SOFT, "WEBP", lossless=True),
    "animated.png": lambda: pages(SOFT, "PNG"),
    "several pages.tiff": lambda: pages(SOFT, "TIFF"),
    "rest after the end.png": lambda: saved(SOFT, "PNG") + b"and more",
}
"""Files that are images, in whatever form; what was made of the first page or frame is known."""

NO_IMAGES: Mapping[str, Callable[[], bytes]] = {
    "empty.png": lambda: b"",
    "zeros.jpg": lambda: bytes(10_000),
    "noise.png": lambda: np.random.default_rng(1).bytes(10_000),
    "text.png": lambda: b"an image, I say" * 100,
    "only a signature.png": lambda: b"\x89PNG\r\n\x1a\n",
    "only a signature.jpg": lambda: b"\xff\xd8\xff",
    "no rows.png": lambda: png(160, 120, b""),
    "too few rows.png": lambda: png(160, 120, bytes(161) * 60),
    "no width.png": lambda: png(0, 120, b""),
    "negative.png": lambda: png(2**31 + 5, 7, b""),
    "wrong colour.png": lambda: png(160, 120, bytes(161) * 120, colour=5),
    "wrong depth.png": lambda: png(160, 120, bytes(161) * 120, depth=3),
    "65535 x 65535.png": lambda: png(65_535, 65_535, b""),
    "65535 x 65535.jpg": lambda: jpeg_of_size(65_535, 65_535),
    "20000 x 20000 of 160 x 120.jpg": lambda: jpeg_of_size(20_000, 20_000),
    "a bomb of 17000 x 17000.png": lambda: bomb(17_000),
    **{f"half.{form}": functools.partial(half, form) for form in ("jpg", "png", "webp", "tiff", "bmp", "gif")},
    "svg.png": lambda: b"<svg xmlns='http://www.w3.org/2000/svg' width='9' height='9'/>",
    "zip.png": lambda: b"PK\x03\x04" + bytes(100),
}
"""Files that are none, or so large that reading them would take the machine down."""
