"""Damaged files of native data sets: one line that names the file and its line."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from fmtorch.data import DataError, load
from tests.data.native import write_bundler, write_colmap, write_kitti, write_tum

Edit = Callable[[str], str | bytes] | None  # None: the file or folder is gone
NAME = "rgbd_dataset_freiburg1_test"


def swap(old: str, new: str) -> Edit:
    def edit(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return edit


def line(number: int, change: Callable[[str], str]) -> Edit:
    def edit(text: str) -> str:
        lines = text.splitlines()
        return "\n".join([*lines[: number - 1], change(lines[number - 1]), *lines[number:]]) + "\n"

    return edit


def word(number: int, value: str) -> Edit:
    """Another first word in a line."""
    return line(number, lambda text: " ".join([value, *text.split()[1:]]))


def cut(count: int) -> Edit:
    return lambda text: "\n".join(text.splitlines()[:count]) + "\n"


CAMERAS, IMAGES = "sparse/0/cameras.txt", "sparse/0/images.txt"
COLMAP: list[tuple[str, Edit, str]] = [
    (CAMERAS, swap("OPENCV", "MAGIC"), r"cameras\.txt, line 4: camera model MAGIC is not known"),
    (CAMERAS, swap("OPENCV", "EQUIRECTANGULAR"), "line 4: camera model EQUIRECTANGULAR is not known"),
    (CAMERAS, swap("41 16 12\n", "41 16\n"), r"cameras\.txt, line 3: 3 parameters; PINHOLE has 4: fx, fy, cx, cy"),
    (CAMERAS, swap("40 41 16 12\n", "40 x 16 12\n"), r"cameras\.txt, line 3: .*'x'"),
    (CAMERAS, swap("40 16 12", "-40 16 12"), r"line 2: .*focal lengths must be positive"),
    (CAMERAS, swap("32 24", "0 24"), r"cameras\.txt, line 2: an image of 0 x 24 px"),
    (CAMERAS, swap("8 PINHOLE", "7 PINHOLE"), r"cameras\.txt, line 3: camera 7 stands twice"),
    (IMAGES, swap(" 7 00.png", " 3 00.png"), r"images\.txt, line 3: camera 3 of 00\.png"),
    (IMAGES, swap("02.png", "00.png"), r"images\.txt, line 7: image 00\.png is already at .*line 3"),
    (IMAGES, swap("20 1.0 0.0 0.0 0.0", "20 0 0 0 0"), r"images\.txt, line 3: quaternion .*; it must be finite"),
    (IMAGES, swap("20 1.0", "20 nan"), r"images\.txt, line 3: a number that is not finite"),
    (IMAGES, swap(" 7 00.png", ""), r"images\.txt, line 3: 8 columns; it must hold IMAGE_ID"),
    (IMAGES, swap(" 4.5 -1\n19", "\n19"), r"images\.txt, line 4: 16 columns; it must be a line"),
    (IMAGES, swap("4.5 0 ", "4.5 zero "), r"images\.txt, line 4: .*'zero'"),
    (IMAGES, swap("images: 3", "images: 4"), r"images\.txt: 3 images, but it announces 4"),
    (IMAGES, lambda _: "# none\n", r"images\.txt: no image; a model"),
    (IMAGES, None, r"images\.txt: no such file"),
]
OUT = "gt_bundle.out"
BUNDLER: list[tuple[str, Edit, str]] = [
    (OUT, line(1, lambda _: "# Bundle file v0.2"), r"gt_bundle\.out, line 1: '# Bundle file v0\.2'; it must"),
    (OUT, line(2, lambda _: "5"), r"line 2: 1 columns; it must hold the numbers of cameras and of points"),
    (OUT, line(2, lambda _: "4 12"), r"line 2: 4 cameras and .*list\.txt has 5 images; both must agree"),
    (OUT, line(2, lambda _: "5 many"), r"line 2: the number of points is 'many'; it must be a whole number"),
    (OUT, cut(40), r"gt_bundle\.out ends at line 40; 5 cameras and 12 points need 63: truncated\?"),
    (OUT, line(3, lambda s: "-" + s), r"line 3: focal length -40; it must be positive"),
    (OUT, line(5, lambda _: "0 2 0"), r"line 3: the matrix is no rotation"),
    (OUT, line(7, lambda _: "nan 0 0"), r"line 7: a number that is not finite; it must hold t"),
    (OUT, line(8, lambda s: s.split()[0]), r"line 8: 1 columns; it must have 3: f k1 k2"),
    (OUT, line(30, lambda s: s + " 7"), r"line 30: 6 columns; it must hold n and n times camera key x y"),
    (OUT, line(30, lambda _: ""), r"line 30: 0 columns; it must hold n and n times"),
    (OUT, None, r"scene: no Bundler file; it must hold one of"),
    (OUT, lambda s: re.sub(r"(?m)^4\d\.0 .*", "0 0 0", s), "no camera has a focal length; none was registered"),
]
POSES, TIMES, CALIB = "poses/06.txt", "sequences/06/times.txt", "sequences/06/calib.txt"
KITTI: list[tuple[str, Edit, str]] = [
    (POSES, None, r"poses/06\.txt: no such file; the layout is"),
    (POSES, cut(9), r"poses/06\.txt ends at line 9 and .*times\.txt at line 14; each must have one line a frame"),
    (f"{POSES} {TIMES}", cut(9), r"poses/06\.txt ends at line 9 and .*image_0 has 14 images"),
    (POSES, line(14, lambda s: " ".join(s.split()[:5])), r"poses/06\.txt, line 14: 5 columns; it must have 12"),
    (POSES, word(3, "x"), r"poses/06\.txt, line 3: .*'x'"),
    (POSES, word(3, "nan"), r"poses/06\.txt, line 3: .*not finite"),
    (POSES, word(5, "2"), r"poses/06\.txt, line 5: the matrix is no rotation"),
    (POSES, line(1, lambda s: " ".join(str(-float(v)) for v in s.split())), r"line 1: the matrix is no rotation"),
    (TIMES, line(1, lambda _: "0.1"), r"times\.txt, line 2: 0\.1 s does not come after 0\.1 s; times must ascend"),
    (CALIB, lambda s: s.partition("\n")[2], r"calib\.txt: no line P0; it must hold P0: to P3:"),
    (CALIB, line(1, lambda s: " ".join(s.split()[:7])), r"calib\.txt, line 1: 6 columns; it must have 12"),
    ("sequences/06/image_0", None, r"image_0: no such folder; the layout is sequences/NN"),
    (POSES, lambda _: b"\xff\xfe", r"poses/06\.txt: cannot be read as text"),
]
RGB, TRUTH = "rgb.txt", "groundtruth.txt"
TUM: list[tuple[str, Edit, str]] = [
    (RGB, None, r"rgb\.txt: no such file; a sequence holds rgb\.txt"),
    (TRUTH, None, r"groundtruth\.txt: no such file; a sequence holds"),
    (RGB, lambda _: "# nothing\n", r"rgb\.txt: no line with timestamp filename"),
    (RGB, line(3, lambda s: s.split()[0]), r"rgb\.txt, line 3: 1 columns; it must hold"),
    (RGB, line(3, lambda s: "x" + s), r"rgb\.txt, line 3: .*could not convert"),
    (RGB, word(5, "1305031236.1"), r"line 5: 1305031236\.1 comes after 1305031236\.203000; time stamps must ascend"),
    (TRUTH, word(50, "1305031236.1"), r"groundtruth\.txt, line 50: 1305031236\.1\d* comes after 1305031236\.47"),
    (TRUTH, line(123, lambda s: s[:30]), r"groundtruth\.txt, line 123: 5 columns; it must have 8: timestamp tx ty tz"),
    (TRUTH, line(9, lambda s: s.replace(" 0.5 ", " nan ")), r"line 9: a number that is not"),
    (TRUTH, line(9, lambda s: " ".join([*s.split()[:4], "0 0 0 0"])), r"line 9: the quaternion is zero"),
    (TRUTH, lambda _: "1305031236 0 0 0 0 0 0 1\n", r"groundtruth\.txt: 1 poses; it must hold lines of"),
    (TRUTH, lambda _: "5 0 0 0 0 0 0 1\n6 0 0 0 0 0 0 1\n", r"groundtruth\.txt: no pose at the times of rgb\.txt; is"),
    ("depth.txt", word(5, "1305031236.1"), r"depth\.txt, line 5: .* time stamps must ascend"),
]
KINDS = {"colmap": COLMAP, "bundler": BUNDLER, "kitti": KITTI, "tum": TUM}
CASES = [(kind, *case) for kind, cases in KINDS.items() for case in cases]


def written(kind: str, folder: Path, depth: bool) -> tuple[Path, dict[str, object]]:
    if kind == "kitti":
        return write_kitti(folder), {"root": folder, "sequences": ["06"]}
    if kind == "tum":
        return write_tum(folder, NAME, depth=depth), {"root": folder, "sequences": [NAME]}
    scene = write_colmap(folder / "scene") if kind == "colmap" else write_bundler(folder / "scene")[0]
    return scene, {"root": scene, "candidates": "points"}


@pytest.mark.parametrize(("kind", "names", "edit", "message"), CASES)
def test_damaged_files_are_named_with_their_lines(kind, names, edit, message, tmp_path):
    folder, options = written(kind, tmp_path, depth=names == "depth.txt")
    for path in (folder / name for name in names.split()):
        if edit is not None:
            changed = edit(path.read_text())
            path.write_bytes(changed if isinstance(changed, bytes) else changed.encode())
        elif path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    with pytest.raises(DataError, match=message) as raised:
        load(kind, **options)
    assert "\n" not in str(raised.value)
