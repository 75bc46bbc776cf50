import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image, ImageOps

from fmtorch.data import ImageError, ImageSource, read_image, stored_size, to_grey
from fmtorch.data.images import stored_orientation

COLOUR = np.random.default_rng(0).integers(0, 256, (37, 53, 3), dtype=np.uint8)


def written(path: Path, image: np.ndarray, *options: int) -> Path:
    assert cv2.imwrite(str(path), image, options)
    return path


@pytest.mark.parametrize("name", ["a.png", "a.tiff", "a.webp"])
def test_colour_comes_as_rgb(tmp_path: Path, name: str) -> None:
    path = written(tmp_path / name, COLOUR[..., ::-1], *([cv2.IMWRITE_WEBP_QUALITY, 101] if "webp" in name else []))
    np.testing.assert_array_equal(read_image(path), COLOUR)
    np.testing.assert_array_equal(read_image(ImageSource("a", path)), COLOUR)
    np.testing.assert_array_equal(read_image(str(path)), COLOUR)


def test_depth_and_transparency_are_reduced(tmp_path: Path) -> None:
    deep = written(tmp_path / "deep.png", COLOUR[..., 0].astype(np.uint16) * 257)
    np.testing.assert_array_equal(read_image(deep), COLOUR[..., 0])
    clear = written(tmp_path / "clear.png", np.dstack([COLOUR[..., ::-1], COLOUR[..., 0]]))
    np.testing.assert_array_equal(read_image(clear), COLOUR)


def test_to_grey_is_opencvs() -> None:
    np.testing.assert_array_equal(to_grey(COLOUR), cv2.cvtColor(COLOUR[..., ::-1].copy(), cv2.COLOR_BGR2GRAY))
    exact = COLOUR @ np.array([0.299, 0.587, 0.114])
    assert np.abs(to_grey(COLOUR) - exact).max() <= 0.5 + 255 * 2.0**-14  # weights rounded to 15 bits
    assert to_grey(COLOUR[..., 0]) is not None
    np.testing.assert_array_equal(to_grey(COLOUR[..., 0]), COLOUR[..., 0])


def jpeg(*options: int) -> bytes:
    smooth = cv2.resize(COLOUR, (320, 240), interpolation=cv2.INTER_CUBIC)
    return bytes(cv2.imencode(".jpg", smooth, options)[1])


JPEGS = {
    "baseline": jpeg(),
    "progressive": jpeg(cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restarts": jpeg(cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
}


@pytest.mark.parametrize("kind", JPEGS)
def test_truncated_jpeg_is_refused(tmp_path: Path, kind: str) -> None:
    path, data = tmp_path / "a.jpg", JPEGS[kind]
    path.write_bytes(data + b"\0" * 100)  # what follows the end is not ours
    assert read_image(path).shape == (240, 320, 3)
    for length in (len(data) - 1, len(data) - 2, len(data) // 2, 40, 3):
        path.write_bytes(data[:length])
        with pytest.raises(ImageError, match=r"a\.jpg: truncated JPEG"):
            read_image(path)


@pytest.mark.parametrize("kind", JPEGS)
def test_a_jpeg_that_libjpeg_warns_of_is_refused(tmp_path: Path, kind: str) -> None:
    path, data, half = tmp_path / "a.jpg", JPEGS[kind], len(JPEGS[kind]) // 2
    damages = {
        "cut, with an end": data[:half] + b"\xff\xd9",
        "zeros": data[:half] + bytes(300) + data[half + 300 :],
        "a piece missing": data[:half] + data[half + 300 :],
    }
    if kind == "restarts":
        damages["order of restarts"] = data.replace(b"\xff\xd3", b"\xff\xd5")
    for name, damaged in damages.items():
        path.write_bytes(damaged)
        assert cv2.imread(str(path)) is not None, name  # OpenCV makes something of it
        with pytest.raises(ImageError, match=r"a\.jpg: corrupt JPEG, its compressed data are damaged"):
            read_image(path)


@pytest.mark.parametrize(
    ("mode", "options"),
    [("L", {}), ("RGB", {"subsampling": "4:1:1"}), ("RGB", {"subsampling": 0, "progressive": True}), ("CMYK", {})],
)
def test_sound_jpegs_of_any_kind_are_read(tmp_path: Path, mode: str, options: dict[str, object]) -> None:
    Image.fromarray(COLOUR).convert(mode).save(tmp_path / "a.jpg", "JPEG", **options)
    assert read_image(tmp_path / "a.jpg").shape[:2] == COLOUR.shape[:2]


def test_a_thumbnails_end_is_not_the_images(tmp_path: Path) -> None:
    data = JPEGS["baseline"]
    thumbnail = b"\xff\xe1" + (len(data) + 2).to_bytes(2, "big") + data  # an application segment that holds a JPEG
    path = tmp_path / "a.jpg"
    path.write_bytes(data[:2] + thumbnail + data[2:])
    assert read_image(path).shape == (240, 320, 3)
    path.write_bytes(data[:2] + thumbnail + data[2 : len(data) // 2])
    with pytest.raises(ImageError, match="truncated"):
        read_image(path)


def test_truncated_or_corrupt_png_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.png", COLOUR)
    data = path.read_bytes()
    for length in (len(data) - 1, len(data) // 2, 8, 20):
        path.write_bytes(data[:length])
        with pytest.raises(ImageError, match=r"a\.png: truncated PNG"):
            read_image(path)
    broken = bytearray(data)
    broken[len(data) // 2] ^= 1
    path.write_bytes(broken)
    with pytest.raises(ImageError, match=r"a\.png: corrupt PNG.*IDAT"):
        read_image(path)


@pytest.mark.parametrize(
    ("content", "message"), [(b"", "empty"), (b"not an image", "no image"), (None, "cannot be read")]
)
def test_what_is_no_image_is_named(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "x.jpg"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ImageError, match=rf"x\.jpg.*{message}"):
        read_image(path)
    with pytest.raises(ImageError, match="cannot be read"):
        read_image(tmp_path)


BLOCKS = np.repeat(
    np.repeat(np.array([[[250, 20, 20], [20, 250, 20]], [[20, 20, 250], [250, 250, 250]]], np.uint8), 24, 0), 40, 1
)


@pytest.mark.parametrize("tag", range(1, 9))
@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif", "avif"])
def test_orientation_tags_turn_on_demand_alone(tmp_path: Path, suffix: str, tag: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = tag
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(BLOCKS).save(path, exif=exif)
    with Image.open(path) as image:
        upright = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    for orient, right in ((False, BLOCKS), (True, upright)):
        read = read_image(path, orient=orient)
        assert read.shape == right.shape
        assert np.abs(read.astype(int) - right).mean() < 8  # coding with losses; a turned image is beyond 60
    assert stored_size(path) == BLOCKS.shape[:2]
    assert stored_orientation(path) == tag


@pytest.mark.parametrize(
    "options", [{"bigtiff": True}, {"byteorder": ">"}, {"dtype": np.uint16}, {"dtype": np.float32}]
)
def test_tiff_of_any_kind_is_read_as_stored(tmp_path: Path, options: dict[str, Any]) -> None:
    image = BLOCKS[..., 0].astype(options.pop("dtype", np.uint8))
    tifffile.imwrite(tmp_path / "a.tif", image, extratags=[(274, "H", 1, 6, True)], **options)
    stored = read_image(tmp_path / "a.tif")
    np.testing.assert_array_equal(stored > 128, tifffile.imread(tmp_path / "a.tif") > 128)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif", orient=True), np.rot90(stored, -1))


@pytest.mark.parametrize(
    ("dtype", "low", "high"), [(np.uint16, 29_300, 30_200), (np.int16, -40, 210), (np.float32, -1.5, 2.25)]
)
def test_deep_images_are_scaled_by_their_range(tmp_path: Path, dtype: type, low: float, high: float) -> None:
    """A thermal camera's counts fill a small part of 16 bits: their upper byte has four levels."""
    shape = np.random.default_rng(1).uniform(size=(40, 60))
    shape[0, :2] = 0, 1
    values = (low + shape * (high - low)).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", values)
    exact = (values.astype(float) - low) / (high - low) * 255
    assert np.abs(read_image(tmp_path / "a.tif") - exact).max() <= 0.5 + 1e-9


def test_values_that_are_no_numbers_are_dark(tmp_path: Path) -> None:
    values = np.array([[np.nan, 1.0], [np.inf, 3.0]], np.float32)
    tifffile.imwrite(tmp_path / "a.tif", values)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), [[0, 0], [0, 255]])
    tifffile.imwrite(tmp_path / "a.tif", values * np.nan)
    with pytest.raises(ImageError, match=r"a\.tif: none of its values is a finite number"):
        read_image(tmp_path / "a.tif")


def test_the_formats_of_the_message_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_bytes(b"no picture")
    with pytest.raises(ImageError) as refusal:
        read_image(tmp_path / "a.xyz")
    suffixes = {"JPEG": "jpg", "TIFF": "tif", "JPEG 2000": "jp2", "PNM": "ppm", "Radiance HDR": "hdr"}
    named = str(refusal.value).partition("must be ")[2].replace(" or ", " ").split(", ")
    for name in (name.strip() for name in named if "HEIC" not in name):
        kind = np.float32 if name == "PFM" else np.uint8
        read = read_image(written(tmp_path / f"a.{suffixes.get(name, name.lower())}", BLOCKS.astype(kind)))
        assert read.shape == BLOCKS.shape, name


def test_heic_is_read_by_pillow_heif_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.heic"
    path.write_bytes(bytes([0, 0, 0, 20]) + b"ftypmif1" + bytes(4) + b"heic" + bytes(40))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(ImageError, match="pip install pillow-heif"):
        read_image(path)
    opened = SimpleNamespace(to_pillow=lambda: Image.fromarray(BLOCKS).convert("RGBA"))
    monkeypatch.setitem(sys.modules, "pillow_heif", SimpleNamespace(open_heif=lambda file: opened))
    np.testing.assert_array_equal(read_image(path, orient=True), BLOCKS)
