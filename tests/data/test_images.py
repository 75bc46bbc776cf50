"""Images as they are read: formats, orientation, EXIF, their cameras."""

import json
import math
import os
import struct
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import ExifTags, Image, ImageOps
from PIL.TiffImagePlugin import IFDRational

import fmtorch
from fmtorch.data import DataError, ExifFocal, ImageCameras, ImageError, ImageSource, Lens, exif_focal, read_image
from tests.data.native import SIZE, to_binary, write_colmap

COLOUR = np.random.default_rng(0).integers(0, 256, (37, 53, 3), dtype=np.uint8)
CORNERS = np.array([[[250, 20, 20], [20, 250, 20]], [[20, 20, 250], [250, 250, 250]]], np.uint8)
BLOCKS = CORNERS.repeat(24, 0).repeat(40, 1)
Tag = ExifTags.Base
PLANE = {"FocalLength": IFDRational(35), "FocalPlaneXResolution": IFDRational(2540)}  # 100 px/mm
PILLOWS_WARNINGS = pytest.mark.filterwarnings("ignore::UserWarning:PIL")


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
    grey, exact = fmtorch.data.to_grey(COLOUR), COLOUR @ np.array([0.299, 0.587, 0.114])
    np.testing.assert_array_equal(grey, cv2.cvtColor(COLOUR[..., ::-1].copy(), cv2.COLOR_BGR2GRAY))
    assert np.abs(grey - exact).max() <= 0.5 + 255 * 2.0**-14  # weights rounded to 15 bits
    np.testing.assert_array_equal(fmtorch.data.to_grey(COLOUR[..., 0]), COLOUR[..., 0])


def jpeg(*options: int) -> bytes:
    smooth = cv2.resize(COLOUR, (320, 240), interpolation=cv2.INTER_CUBIC)
    return bytes(cv2.imencode(".jpg", smooth, options)[1])


PROGRESSIVE, RESTARTS = (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 2)
JPEGS = {"baseline": jpeg(), "progressive": jpeg(*PROGRESSIVE), "restarts": jpeg(*RESTARTS)}


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
    begin, end = data[:half], data[half + 300 :]
    damages = {"cut, ended": begin + b"\xff\xd9", "zeros": begin + bytes(300) + end, "a piece missing": begin + end}
    if kind == "restarts":
        damages["order of restarts"] = data.replace(b"\xff\xd3", b"\xff\xd5")
    for name, damaged in damages.items():
        path.write_bytes(damaged)
        assert cv2.imread(str(path)) is not None, name  # OpenCV makes something of it
        with pytest.raises(ImageError, match=r"a\.jpg: corrupt JPEG, its compressed data are damaged"):
            read_image(path)


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
    for length in (len(data) - 9, len(data) // 2, 8, 20):
        path.write_bytes(data[:length])
        with pytest.raises(ImageError, match=r"a\.png: corrupt or truncated PNG"):
            read_image(path)
    broken = bytearray(data)
    broken[len(data) // 2] ^= 1
    path.write_bytes(broken)
    with pytest.raises(ImageError, match=r"a\.png: corrupt or truncated PNG.*IDAT"):
        read_image(path)


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    """A pipe would block for ever, a device fill the memory."""
    os.mkfifo(tmp_path / "pipe.jpg")
    (tmp_path / "zero.jpg").symlink_to("/dev/zero")
    for name in ("pipe.jpg", "zero.jpg", "none.jpg", ""):
        said = "no regular file; it must be an image file" if name[:1] in ("p", "z") else "cannot be read"
        with pytest.raises(ImageError, match=f"{tmp_path / name}: {said}"):
            read_image(tmp_path / name)


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
    assert (fmtorch.data.stored_size(path), fmtorch.data.stored_orientation(path)) == (BLOCKS.shape[:2], tag)


TILED, RGB = {"tile": (32, 32)}, {"photometric": "rgb"}
TIFFS: list[dict[str, Any]] = [
    {"bigtiff": True}, {"byteorder": ">"}, {"dtype": "u2"}, {"dtype": "f4"}, RGB | {"dtype": "f4"}, TILED | RGB,
    RGB | {"dtype": "i2"}, TILED | {"bigtiff": True, "byteorder": ">"}, TILED | {"compression": "zlib"},
]  # fmt: skip


@pytest.mark.parametrize("tag", [3, 6])
@pytest.mark.parametrize("options", TIFFS)
def test_tiff_of_any_kind_is_read_as_stored(tmp_path: Path, options: dict[str, Any], tag: int) -> None:
    image, written = BLOCKS if "photometric" in options else BLOCKS[..., 0], {"dtype": "u1"} | options
    image = image.astype(written.pop("dtype"))
    tifffile.imwrite(tmp_path / "a.tif", image, extratags=[(274, "H", 1, tag, True)], **written)
    stored = read_image(tmp_path / "a.tif")
    np.testing.assert_array_equal(stored > 128, tifffile.imread(tmp_path / "a.tif") > 128)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif", orient=True), np.rot90(stored, {3: 2, 6: -1}[tag]))
    assert fmtorch.data.stored_orientation(tmp_path / "a.tif") == tag


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


def test_values_that_are_no_numbers_or_all_alike_are_dark(tmp_path: Path) -> None:
    values = np.array([[np.nan, 1.0], [np.inf, 3.0]])
    constant = np.array([[500.0, 500.0], [np.inf, 500.0]])
    wide, narrow = np.array([[-1.7e308, 1.7e308]]), np.array([[0.0, 5e-324]])
    for image, read in ((values, [[0, 0], [0, 255]]), (constant, 0), (wide, [[0, 255]]), (narrow, [[0, 255]])):
        tifffile.imwrite(tmp_path / "a.tif", image)
        with np.errstate(all="raise"):
            np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), read)
    tifffile.imwrite(tmp_path / "a.tif", values * np.nan)
    with pytest.raises(ImageError, match=r"a\.tif: none of its values is a finite number"):
        read_image(tmp_path / "a.tif")


def test_a_tiff_that_opencv_does_not_decode_is_refused_in_a_line(tmp_path: Path, capfd: Any) -> None:
    tifffile.imwrite(tmp_path / "a.tif", BLOCKS[..., 0].astype(np.float16))
    with pytest.raises(ImageError, match=r"a\.tif: no image.*; it must be a sound TIFF of 8 or 16 bits or float32"):
        read_image(tmp_path / "a.tif")
    assert capfd.readouterr() == ("", "")


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


def with_exif(folder: Path, size: tuple[int, int], name: str = "a.jpg", **tags: object) -> Path:
    exif = Image.Exif()
    exif[Tag.Orientation] = 6
    exif.get_ifd(ExifTags.IFD.Exif).update({Tag[key]: value for key, value in tags.items()})
    path = folder / name
    Image.new("RGB", size[::-1]).save(path, exif=exif)
    return path


def test_the_equivalent_is_that_of_the_diagonal(tmp_path: Path) -> None:
    three_to_two = exif_focal(with_exif(tmp_path, (400, 600), FocalLengthIn35mmFilm=50))
    assert three_to_two.focal == pytest.approx(50 * 600 / 36)  # where width and diagonal agree
    assert three_to_two.source == "FocalLengthIn35mmFilm 50 mm"
    four_to_three = exif_focal(with_exif(tmp_path, (3024, 4032), FocalLengthIn35mmFilm=26))
    assert four_to_three.focal == pytest.approx(26 * 5040 / math.sqrt(36**2 + 24**2))
    # A telephone of that equivalent: 4.25 mm, pixels of 1.4 micrometres.
    assert abs(four_to_three.focal / (4.25 / 0.0014) - 1) < 0.01 < abs(26 * 4032 / 36 / (4.25 / 0.0014) - 1)


def test_rounding_counts(tmp_path: Path) -> None:
    def deviation(equivalent: int) -> float:
        return exif_focal(with_exif(tmp_path, (400, 600), FocalLengthIn35mmFilm=equivalent)).deviation

    assert deviation(14) == pytest.approx(math.hypot(0.06, 1 / math.sqrt(12) / 14))
    assert 0.06 < deviation(200) < deviation(14) < 0.065


@pytest.mark.parametrize(("unit", "mm"), [(2, 25.4), (3, 10.0), (None, 25.4)])
def test_the_sensor_gives_the_focal_length_where_there_is_no_equivalent(unit, mm, tmp_path):
    tags = {"FocalLength": IFDRational(35), "FocalPlaneXResolution": IFDRational(round(100 * mm), 1)}
    tags |= {"FocalLengthIn35mmFilm": 0, **({} if unit is None else {"FocalPlaneResolutionUnit": unit})}
    exif = exif_focal(with_exif(tmp_path, (2000, 3000), **tags))  # 100 px/mm: a sensor of 30 mm
    assert exif.focal == pytest.approx(3500, rel=1e-3)  # of inches, a whole number of pixels
    assert exif.deviation == 0.04
    assert exif.source.startswith("FocalLength 35 mm, FocalPlaneXResolution 100")


def test_reduced_and_turned_images(tmp_path: Path) -> None:
    plane = {**PLANE, "ExifImageWidth": 3000, "ExifImageHeight": 2000}
    assert exif_focal(with_exif(tmp_path, (400, 600), **plane)).focal == pytest.approx(700)
    turned = with_exif(tmp_path, (600, 400), **plane)  # when it was reduced
    assert exif_focal(turned).focal == pytest.approx(700)
    path = with_exif(tmp_path, (2000, 3000), **plane, FocalLengthIn35mmFilm=30)
    full_size = exif_focal(path)
    assert exif_focal(path, (3000, 2000)) == full_size
    assert exif_focal(path, (200, 300)).focal == pytest.approx(full_size.focal / 10)


def test_every_format_that_holds_the_tags(tmp_path: Path) -> None:
    for suffix in ("jpg", "png", "webp"):
        path = with_exif(tmp_path, (40, 60), f"a.{suffix}", FocalLengthIn35mmFilm=36)
        assert exif_focal(path).focal == pytest.approx(60), suffix
    # TIFF: a directory of the image at byte 8, the one of EXIF after it, and a strip of zeros
    image = [(256, 60), (257, 40), (258, 8), (259, 1), (262, 1), (273, 200), (277, 1), (278, 40), (279, 2400)]
    of_image, of_exif = [(tag, 4, 1, value) for tag, value in [*image, (0x8769, 150)]], [(0xA405, 3, 1, 36)]
    data = b"II*\0\x08\0\0\0" + directory(of_image)
    (tmp_path / "a.tif").write_bytes(data.ljust(150, b"\0") + directory(of_exif).ljust(2450, b"\0"))
    assert exif_focal(tmp_path / "a.tif").focal == pytest.approx(60)


def directory(entries: list[tuple[int, int, int, int]]) -> bytes:
    """A little-endian TIFF directory of (tag, type, count, value)."""
    body = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return struct.pack("<H", len(entries)) + body + b"\0\0\0\0"


@pytest.mark.parametrize(("tags", "reason"), [
    ({"FocalLength": IFDRational(35)}, "no FocalLengthIn35mmFilm, and no FocalLength with FocalPlaneXResolution"),
    ({"FocalLengthIn35mmFilm": 0}, "no FocalLengthIn35mmFilm"),
    ({"FocalLength": IFDRational(35, 0), "FocalPlaneXResolution": IFDRational(100)}, "no FocalLengthIn35mmFilm"),
    ({**PLANE, "FocalPlaneResolutionUnit": 9}, "no FocalLengthIn35mmFilm"),
    ({**PLANE, "DigitalZoomRatio": IFDRational(2)}, "no FocalLengthIn35mmFilm"),
    ({"FocalLengthIn35mmFilm": 2}, "give 33.33 px for an image of 600 px: a mistake"),
    ({"FocalLengthIn35mmFilm": 65535}, "a mistake"),
    ({"FocalLengthIn35mmFilm": 50, "ExifImageWidth": 600, "ExifImageHeight": 300}, "cropped: 600 x 400 px, rec"),
    ({}, "no EXIF data"),
])  # fmt: skip
def test_what_tells_no_focal_length_says_why(tags: dict[str, object], reason: str, tmp_path: Path) -> None:
    exif = exif_focal(with_exif(tmp_path, (400, 600), **tags))
    assert not exif.known
    assert math.isinf(exif.deviation)
    assert reason in exif.source


def test_files_that_are_no_images(tmp_path: Path) -> None:
    assert "cannot be read" in exif_focal(tmp_path / "none.jpg").source
    assert "cannot be read" in exif_focal(tmp_path).source
    for content in (b"", b"text", b"\xff\xd8\xff"):
        (tmp_path / "a.jpg").write_bytes(content)
        assert "cannot be read" in exif_focal(tmp_path / "a.jpg").source
    Image.new("RGB", (60, 40)).save(tmp_path / "b.jpg")
    assert exif_focal(tmp_path / "b.jpg") == pytest.approx(ExifFocal(math.nan, math.inf, "no EXIF data"), nan_ok=True)


def sound(exif: ExifFocal) -> bool:
    """A focal length in pixels, or none and a reason."""
    if exif.known:
        return 0.2 * 60 <= exif.focal <= 50 * 60 and 0 < exif.deviation < 1
    return bool(exif.source) and math.isinf(exif.deviation)


@PILLOWS_WARNINGS
def test_damage_never_raises(tmp_path: Path) -> None:
    tags = {"FocalLength": IFDRational(35), "FocalPlaneXResolution": IFDRational(254), "FocalLengthIn35mmFilm": 30}
    intact = with_exif(tmp_path, (40, 60), **tags).read_bytes()
    assert exif_focal(tmp_path / "a.jpg").known
    at = intact.index(b"Exif")
    rng, path, outcomes = np.random.default_rng(0), tmp_path / "b.jpg", set()
    for _ in range(500):
        data = bytearray(intact)
        for position in rng.integers(at, at + 160, rng.integers(1, 6)):
            data[position] = rng.choice([0, 1, 127, 255, rng.integers(256)])
        path.write_bytes(data[: rng.integers(4, len(data))] if rng.random() < 0.2 else data)
        exif = exif_focal(path)
        outcomes.add(exif.known)
        assert sound(exif), exif
    assert outcomes == {True, False}


@PILLOWS_WARNINGS
@pytest.mark.parametrize("entries", [
    [(0x8769, 4, 1, 8)],  # a directory that is its own
    [(0x8769, 4, 1, 2**32 - 1)], [(0x8769, 2, 4, 0)], [(0x8769, 4, 2**31, 8)],
    [(0xA405, 3, 2**32 - 1, 8), (0x920A, 5, 2**31, 16), (0x8769, 4, 1, 8)],
    [(0x920A, 12, 1, 8), (0xA20E, 10, 1, 8), (0xA405, 2, 4, 0x41414141), (0x8769, 4, 1, 8)],
])  # fmt: skip
def test_directories_that_lie_end(entries: list[tuple[int, int, int, int]], tmp_path: Path) -> None:
    tiff = b"II*\0\x08\0\0\0" + directory(entries)
    Image.new("RGB", (60, 40)).save(tmp_path / "a.jpg", exif=b"Exif\0\0" + tiff)
    assert sound(exif_focal(tmp_path / "a.jpg"))


@pytest.mark.parametrize("binary", [False, True])
def test_a_model_by_its_folder_and_by_its_file(binary: bool, tmp_path: Path) -> None:
    """COLMAP's (16, 12) is the middle of a 32 x 24 image; here that middle is (15.5, 11.5)."""
    images = write_colmap(tmp_path) / "images"
    sparse = tmp_path / "sparse" / "0"
    if binary:
        to_binary(sparse)
    for path in (sparse, sparse / ("cameras.bin" if binary else "cameras.txt")):
        cameras = ImageCameras(path)
        assert cameras.of(images / "00.png") == (Lens(40.0, 40.0, 15.5, 11.5, "SIMPLE_PINHOLE"), SIZE)
        lens, _ = cameras.of(images / "02.png")
        assert (lens, lens.bends) == (Lens(40.0, 41.0, 15.5, 11.5, "OPENCV", (0.1, -0.02, 0.001, 0.002)), True)
        assert cameras.of(images / "night walk" / "01.png").lens == Lens(40.0, 41.0, 15.5, 11.5, "PINHOLE")
        with pytest.raises(DataError, match=r"no camera of .*x01.png; it has those of 3 images: 00.png"):
            cameras.of(images / "x01.png")


def test_names_within_folders_win_over_shorter_ones(tmp_path: Path) -> None:
    (tmp_path / "k.json").write_text(json.dumps({"a.jpg": [1, 2, 3, 4], "left/a.jpg": [5, 6, 7, 8], "b.jpg": None}))
    cameras = ImageCameras(tmp_path / "k.json")
    assert cameras.of(Path("right/a.jpg")).lens == Lens(1.0, 2.0, 3.0, 4.0)
    assert cameras.of(Path("left/a.jpg")).lens == Lens(5.0, 6.0, 7.0, 8.0)
    assert cameras.of(tmp_path / "b.jpg") == (None, None)


def test_one_camera_without_images_is_that_of_all(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"neither cameras\.bin nor cameras\.txt"):
        ImageCameras(tmp_path)
    (tmp_path / "cameras.txt").write_text("# one\n1 PINHOLE 32 24 40 41 16 12\n")
    assert ImageCameras(tmp_path / "cameras.txt").of(Path("any.jpg")) == (Lens(40.0, 41.0, 15.5, 11.5), (24, 32))
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 32 24 40 41 16 12\n2 PINHOLE 32 24 40 41 16 12\n")
    with pytest.raises(DataError, match=r"2 cameras and no images\.txt"):
        ImageCameras(tmp_path / "cameras.txt")


@pytest.mark.parametrize("content", [
    "", "[1, 2]", "{}", '{"a.jpg": [1, 2, 3]}', '{"a.jpg": [0, 1, 2, 3]}', '{"a.jpg": [1, 2, 3, NaN]}',
    '{"a.jpg": "700"}', '{"a.jpg": [[1, 0, 2], [0, 1, 2], [0, 0, 1]]}',
])  # fmt: skip
def test_json_of_anything_else_is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "k.json").write_text(content)
    with pytest.raises(DataError, match=r"k\.json.*it must be .*\[?fx, fy, cx, cy"):
        ImageCameras(tmp_path / "k.json")
