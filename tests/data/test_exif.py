"""Focal lengths from EXIF data: the conventions, what is refused, and files that are damaged."""

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from fmtorch.data import ExifFocal, exif_focal

Tag = ExifTags.Base
PLANE = {"FocalLength": IFDRational(35), "FocalPlaneXResolution": IFDRational(2540)}  # 100 px/mm
PILLOWS_WARNINGS = pytest.mark.filterwarnings("ignore::UserWarning:PIL")


def written(folder: Path, size: tuple[int, int], name: str = "a.jpg", **tags: object) -> Path:
    """A file of this size (h, w) with these tags."""
    exif = Image.Exif()
    exif[Tag.Orientation] = 6
    exif.get_ifd(ExifTags.IFD.Exif).update({Tag[key]: value for key, value in tags.items()})
    path = folder / name
    Image.new("RGB", size[::-1]).save(path, exif=exif)
    return path


def test_the_equivalent_is_that_of_the_diagonal(tmp_path: Path) -> None:
    three_to_two = exif_focal(written(tmp_path, (400, 600), FocalLengthIn35mmFilm=50))
    assert three_to_two.focal == pytest.approx(50 * 600 / 36)  # where width and diagonal agree
    assert three_to_two.source == "FocalLengthIn35mmFilm 50 mm"
    four_to_three = exif_focal(written(tmp_path, (3024, 4032), FocalLengthIn35mmFilm=26))
    assert four_to_three.focal == pytest.approx(26 * 5040 / math.sqrt(36**2 + 24**2))
    # A telephone of that equivalent: 4.25 mm, pixels of 1.4 micrometres.
    assert abs(four_to_three.focal / (4.25 / 0.0014) - 1) < 0.01 < abs(26 * 4032 / 36 / (4.25 / 0.0014) - 1)


def test_rounding_counts(tmp_path: Path) -> None:
    def deviation(equivalent: int) -> float:
        return exif_focal(written(tmp_path, (400, 600), FocalLengthIn35mmFilm=equivalent)).deviation

    assert deviation(14) == pytest.approx(math.hypot(0.06, 1 / math.sqrt(12) / 14))
    assert 0.06 < deviation(200) < deviation(14) < 0.065


@pytest.mark.parametrize(("unit", "mm"), [(2, 25.4), (3, 10.0), (None, 25.4)])
def test_the_sensor_gives_the_focal_length_where_there_is_no_equivalent(
    unit: int | None, mm: float, tmp_path: Path
) -> None:
    tags = {"FocalLength": IFDRational(35), "FocalPlaneXResolution": IFDRational(round(100 * mm), 1)}
    tags |= {"FocalLengthIn35mmFilm": 0, **({} if unit is None else {"FocalPlaneResolutionUnit": unit})}
    exif = exif_focal(written(tmp_path, (2000, 3000), **tags))  # 100 px/mm: a sensor of 30 mm
    assert exif.focal == pytest.approx(3500, rel=1e-3)  # of inches, a whole number of pixels
    assert exif.deviation == 0.04
    assert exif.source.startswith("FocalLength 35 mm, FocalPlaneXResolution 100")


def test_reduced_and_turned_images(tmp_path: Path) -> None:
    plane = {**PLANE, "ExifImageWidth": 3000, "ExifImageHeight": 2000}
    assert exif_focal(written(tmp_path, (400, 600), **plane)).focal == pytest.approx(700)
    assert exif_focal(written(tmp_path, (600, 400), **plane)).focal == pytest.approx(700)  # turned when it was reduced
    path = written(tmp_path, (2000, 3000), **plane, FocalLengthIn35mmFilm=30)
    full_size = exif_focal(path)
    assert exif_focal(path, (3000, 2000)) == full_size
    assert exif_focal(path, (200, 300)).focal == pytest.approx(full_size.focal / 10)


def test_every_format_that_holds_the_tags(tmp_path: Path) -> None:
    for suffix in ("jpg", "png", "webp"):
        path = written(tmp_path, (40, 60), f"a.{suffix}", FocalLengthIn35mmFilm=36)
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
    exif = exif_focal(written(tmp_path, (400, 600), **tags))
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
    intact = written(tmp_path, (40, 60), **tags).read_bytes()
    assert exif_focal(tmp_path / "a.jpg").known
    at = intact.index(b"Exif")
    rng, path, outcomes = np.random.default_rng(0), tmp_path / "b.jpg", set()
    for _ in range(1500):
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
