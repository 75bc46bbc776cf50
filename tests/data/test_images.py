from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from fmtorch.data import ImageError, ImageSource, read_image, to_grey

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


STORED = {  # how an image is stored for each value of the orientation
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: np.rot90(image, 2),
    6: lambda image: np.rot90(image, 1),  # shown after a quarter turn clockwise
    8: lambda image: np.rot90(image, -1),
}


@pytest.mark.parametrize("orientation", STORED)
def test_exif_orientation_only_on_demand(orientation: int, tmp_path: Path) -> None:
    exif, smooth = Image.Exif(), cv2.resize(COLOUR, (320, 240), interpolation=cv2.INTER_CUBIC)
    exif[ExifTags.Base.Orientation] = orientation
    stored = np.ascontiguousarray(STORED[orientation](smooth))
    Image.fromarray(stored).save(tmp_path / "a.jpg", exif=exif, quality=95)
    for image, expected in (
        (read_image(tmp_path / "a.jpg"), stored),
        (read_image(tmp_path / "a.jpg", orient=True), smooth),
    ):
        assert np.abs(image.astype(int) - expected).mean() < 5  # grey levels, of JPEG
