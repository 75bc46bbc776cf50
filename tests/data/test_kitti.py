"""The reader of KITTI odometry: against the FM-Bench copy of the same frames, and on damaged files."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from fmtorch.data import DataError, load
from fmtorch.geometry import fundamental_from_projections
from tests.conftest import shared_path
from tests.data.native import write_kitti
from tests.helpers import apart, edit_lines

FIRST = 40  # frame of the sequence with which the FM-Bench copy and the native piece begin


def test_real_frames_have_the_f_of_the_fmbench_file() -> None:
    """All pairs of the native frames, from both files' cameras, and those pairs that the FM-Bench file lists."""
    native = load("kitti", root=shared_path("data/native/kitti_odometry"), sequences=["00"], pairs=None)
    copy = shared_path("data/KITTI/00/Camera.txt")
    rows = np.loadtxt(copy)
    P = [row[:9].reshape(3, 3) @ np.column_stack([row[9:18].reshape(3, 3), row[18:]]) for row in rows]
    listed = {pair.identity: pair.F for pair in load("fmbench", root=copy.parents[1])}
    shared = 0
    assert len(native) == 28  # of 8 frames within a second
    for pair in native:
        i, j = map(int, pair.identity.rpartition("/")[2].split("-"))
        F = fundamental_from_projections(torch.from_numpy(P[i]), torch.from_numpy(P[j])).numpy()
        assert apart(pair.F, F) < 1e-6
        assert pair.problem is None
        if pair.identity in listed:
            shared += 1
            assert apart(pair.F, listed[pair.identity]) < 1e-6
    assert shared == 3


def test_f_is_that_of_the_projection_matrices_of_each_camera(tmp_path: Path) -> None:
    """Camera 1 is shifted by 21.5 / 40 metres: its P is ``P1 [R | t]^-1`` by the devkit's definition."""
    root = write_kitti(tmp_path)
    poses = np.loadtxt(root / "poses/06.txt").reshape(-1, 3, 4)
    (root / "sequences/06/image_0").rename(root / "sequences/06/image_1")
    for pair in load("kitti", root=root, sequences=["06"], camera=1, pairs=20):
        P1 = np.array([[40, 0, 15.5, -21.5], [0, 40, 11.5, 0], [0, 0, 1, 0]])
        i, j = map(int, pair.identity.rpartition("/")[2].split("-"))
        P = [torch.from_numpy(P1 @ np.linalg.inv(np.vstack([poses[k], [0, 0, 0, 1]]))) for k in (i, j)]
        assert apart(pair.F, fundamental_from_projections(*P).numpy()) < 1e-6
        assert np.linalg.norm(pair.F) == pytest.approx(1)


def test_a_draw_is_of_the_seed_and_part_of_the_digest(tmp_path: Path) -> None:
    root = write_kitti(tmp_path, names=("06", "07"))
    first, again, other = (load("kitti", root=root, sequences=["06", "07"], pairs=30, seed=s) for s in (0, 0, 1))
    names = [[p.identity for p in d] for d in (first, again, other)]
    assert names[0] == names[1] != names[2]
    assert first.digest == again.digest != other.digest
    assert len(set(names[0])) == 30
    assert {p.scene for p in first} == {"06", "07"}


def rewrite(name: str, change: Callable[[list[str]], list[str]]) -> Callable[[Path], None]:
    return lambda root: edit_lines(root / name, change)


def words(line: int, change: Callable[[list[str]], list[str]]) -> Callable[[list[str]], list[str]]:
    return lambda lines: [" ".join(change(text.split())) if i == line else text for i, text in enumerate(lines)]


DAMAGE = {
    "no poses": (lambda root: (root / "poses/06.txt").unlink(), r"poses/06\.txt: no such file; the layout is"),
    "truncated poses": (
        rewrite("poses/06.txt", lambda lines: lines[:9]),
        r"poses/06\.txt ends at line 9 and .*times\.txt at line 14; each must have one line a frame",
    ),
    "both truncated": (
        lambda root: [rewrite(f, lambda lines: lines[:9])(root) for f in ("poses/06.txt", "sequences/06/times.txt")],
        r"poses/06\.txt ends at line 9 and .*image_0 has 14 images",
    ),
    "cut within a line": (
        rewrite("poses/06.txt", words(13, lambda w: w[:5])),
        r"poses/06\.txt, line 14: 5 columns; it must have 12",
    ),
    "no number": (rewrite("poses/06.txt", words(2, lambda w: ["x", *w[1:]])), r"poses/06\.txt, line 3: .*'x'"),
    "nan": (rewrite("poses/06.txt", words(2, lambda w: ["nan", *w[1:]])), r"poses/06\.txt, line 3: .*not finite"),
    "no rotation": (
        rewrite("poses/06.txt", words(4, lambda w: ["2", *w[1:]])),
        r"poses/06\.txt, line 5: the matrix is no rotation",
    ),
    "mirrored": (
        rewrite("poses/06.txt", words(0, lambda w: [str(-float(v)) for v in w])),
        r"poses/06\.txt, line 1: the matrix is no rotation",
    ),
    "times out of order": (
        rewrite("sequences/06/times.txt", lambda lines: [lines[1], lines[0], *lines[2:]]),
        r"times\.txt, line 2: 0 s does not come after 0\.1 s; times must ascend",
    ),
    "no camera": (
        rewrite("sequences/06/calib.txt", lambda lines: lines[1:]),
        r"calib\.txt: no line P0; it must hold P0: to P3:",
    ),
    "short projection": (
        rewrite("sequences/06/calib.txt", words(0, lambda w: w[:7])),
        r"calib\.txt, line 1: 6 columns; it must have 12",
    ),
    "no images": (
        lambda root: (root / "sequences/06/image_0").rename(root / "gone"),
        r"image_0: no such folder; the layout is sequences/NN",
    ),
    "no text": (
        lambda root: (root / "poses/06.txt").write_bytes(b"\xff\xfe"),
        r"poses/06\.txt: cannot be read as text",
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_files_are_named_with_their_lines(damage: str, tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    change, message = DAMAGE[damage]
    change(root)
    with pytest.raises(DataError, match=message) as raised:
        load("kitti", root=root, sequences=["06"])
    assert "\n" not in str(raised.value)


def test_a_missing_image_is_a_problem_of_its_pairs_alone(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (root / "sequences/06/image_0/000003.png").unlink()
    pairs = {p.identity.rpartition("/")[2]: p for p in load("kitti", root=root, sequences=["06"], pairs=None)}
    assert pairs["0-1"].problem is None
    assert re.search(r"poses/06\.txt, line 4: no image .*000003\.png$", pairs["3-5"].problem or "")


def test_a_car_that_stands_still_has_no_f(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    rewrite("poses/06.txt", lambda lines: [lines[0], lines[0], *lines[2:]])(root)
    pairs = {p.identity.rpartition("/")[2]: p for p in load("kitti", root=root, sequences=["06"], pairs=None)}
    assert "line 2: both cameras are at one place, hence there is no F" in (pairs["0-1"].problem or "")
    assert not pairs["0-1"].F.any()
    assert pairs["1-2"].problem is None


def test_missing_sequences_and_roots_are_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="kitti needs root: the folder with sequences/ and poses/"):
        load("kitti")
    with pytest.raises(DataError, match="sequences: no such folder; it must hold a folder for each sequence"):
        load("kitti", root=tmp_path)
    root = write_kitti(tmp_path)
    with pytest.raises(
        DataError, match=r"no sequence '07'; there are: 06\. dataset\.sequences=\[\.\.\.\] takes others"
    ):
        load("kitti", root=root)
    with pytest.raises(DataError, match="split 'validation'; there are test and train"):
        load("kitti", split="validation", root=root)
    with pytest.raises(DataError, match="one is named twice"):
        load("kitti", root=root, sequences=["06", "06"])
