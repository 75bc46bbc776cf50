"""FM-Bench, HPatches, and parts of data sets."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from fmtorch.data import DataError, DepthDataset, FMBenchPairs, PairDataset, load, read_image
from fmtorch.data.pairs import PairSubset
from tests.conftest import shared_path
from tests.data import native
from tests.helpers import apart
from tests.reference.solvers import skew

LINE = "0 1 0 0 0 0 0 -2 0 2 0"
NO_IMAGE = ("0 7 0 0 0 0 0 -2 0 2 0", r"no image .*a/Images/00000007\.jpg \(or \.png\)")
NUMBERS = {"nan 0 0 0 0 -2 0 2 0": "not finite", "inf 0 0 0 0 -2 0 2 0": "not finite", "0 0 0 0 0 0 0 0 0": "F is zero"}


def write_set(folder: Path, lines: list[str], subsets: list[str], images: dict[str, list[str]]) -> Path:
    folder.mkdir(parents=True)
    (folder / "pairs_with_gt.txt").write_text("\n".join(lines) + "\n")
    (folder / "pairs_which_dataset.txt").write_text("\n".join(subsets) + "\n")
    for part, names in images.items():
        (folder / part / "Images").mkdir(parents=True)
        for name in names:
            (folder / part / "Images" / name).write_bytes(b"")
    return folder


def small_set(folder: Path) -> Path:
    return write_set(folder, [LINE, "1 2" + LINE[3:]], ["a/", "b/"], {
        "a": ["00000000.jpg", "00000001.png"], "b": ["00000001.jpg", "00000002.jpg"],
    })  # fmt: skip


def test_a_pair(tmp_path: Path) -> None:
    pair = FMBenchPairs(small_set(tmp_path / "Set"))[0]
    assert (pair.identity, pair.family, pair.scene, pair.problem) == ("Set/a/0-1", "Set", "a", None)
    assert (pair.image0.identity, pair.image1.path.name) == ("Set/a/00000000", "00000001.png")
    np.testing.assert_allclose(pair.F, np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]]) / np.sqrt(2), rtol=1e-15)
    assert pair.K0 is None


def test_a_folder_of_sets(tmp_path: Path) -> None:
    small_set(tmp_path / "B")
    small_set(tmp_path / "A")
    (tmp_path / "other").mkdir()
    assert [p.family for p in load("fmbench", root=tmp_path)] == ["A", "A", "B", "B"]
    assert [p.identity for p in load("fmbench", root=tmp_path, sets=["B", "A"], subset="b")] == ["B/b/1-2", "A/b/1-2"]
    with pytest.raises(DataError, match="no set 'C'; it has A, B"):
        load("fmbench", root=tmp_path, sets=["C"])
    with pytest.raises(DataError, match="no pairs of subset 'c'; it has a, b"):
        load("fmbench", root=tmp_path, subset=["a", "c"])


@pytest.mark.parametrize(("line", "reason"), [*((f"0 1 {F}", reason) for F, reason in NUMBERS.items()), NO_IMAGE])
def test_one_bad_line_is_one_bad_pair(tmp_path: Path, line: str, reason: str) -> None:
    root = write_set(tmp_path / "S", [LINE, line, LINE], ["a/"] * 3, {"a": ["00000000.jpg", "00000001.jpg"]})
    pairs = list(FMBenchPairs(root))
    assert pairs[0].problem is None
    assert pairs[2].problem is None
    assert "pairs_with_gt.txt, line 2: " in pairs[1].problem
    assert re.search(reason, pairs[1].problem)
    assert np.isfinite(pairs[1].F).all()


@pytest.mark.parametrize(
    ("lines", "subsets", "message"),
    [
        ([LINE, LINE + " 3"], ["a/", "a/"], r"pairs_with_gt\.txt, line 2: 12 columns; it must have 11: l r F11"),
        ([LINE, "", LINE], ["a/"] * 3, "line 2: 0 columns"),
        ([LINE, LINE.replace("-2", "two")], ["a/", "a/"], "line 2: .*'two'; it must hold 11 numbers"),
        ([LINE], ["a/", "a/"], r"pairs_which_dataset\.txt has 2 lines and .*pairs_with_gt\.txt has 1"),
        (["0.5" + LINE[1:]], ["a/"], "line 1: image number 0.5; it must be a whole number"),
        (["nan" + LINE[1:]], ["a/"], "image number nan"),
        (["inf" + LINE[1:]], ["a/"], "image number inf"),
        ([LINE], ["z/"], r"names z/, but there is no folder .*z/Images"),
    ],
)
def test_unreliable_files_are_refused(tmp_path: Path, lines: list[str], subsets: list[str], message: str) -> None:
    root = write_set(tmp_path / "S", lines, subsets, {"a": ["00000000.jpg", "00000001.jpg"]})
    with pytest.raises(DataError, match=message):
        FMBenchPairs(root)


def test_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        FMBenchPairs(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"neither pairs_with_gt\.txt nor a sub-folder"):
        FMBenchPairs(tmp_path)
    root = small_set(tmp_path / "S")
    (root / "pairs_which_dataset.txt").unlink()
    with pytest.raises(DataError, match=r"pairs_which_dataset\.txt: no such file"):
        FMBenchPairs(root)
    with pytest.raises(DataError, match="split 'train'"):
        FMBenchPairs(root, split="train")


def test_cameras_must_fit(tmp_path: Path) -> None:
    root = small_set(tmp_path / "S")
    (root / "a/Camera.txt").write_text(" ".join("1" * 21))
    with pytest.raises(DataError, match=r"Camera\.txt has 1 lines, but .*line 1 names image 1"):
        FMBenchPairs(root)
    (root / "a/Camera.txt").write_text("1 2 3")
    with pytest.raises(DataError, match=r"3 columns; it must have 21: K .*cameras=false"):
        FMBenchPairs(root)
    assert len(FMBenchPairs(root, cameras=False)) == 2


def test_real_sets() -> None:
    dataset = load("fmbench", root=shared_path("data"))
    counts = {family: sum(p.family == family for p in dataset) for family in {p.family for p in dataset}}
    assert counts == {"KITTI": 100, "PhotoTourism": 34, "Strecha": 79, "Strecha_train": 73, "TUM": 100, "TanksLike": 99}
    assert len({p.key for p in dataset}) == len(dataset)
    assert all(p.problem is None for p in dataset)
    pair = next(p for p in dataset if p.scene == "sacre_coeur")
    assert read_image(pair.image0).ndim == 3

    # F = K1^-T [t]x R K0^-1, up to scale and sign; the cameras are given with 17 digits.
    for pair in list(dataset)[::25]:
        F = np.linalg.inv(pair.K1).T @ skew(pair.t) @ pair.R @ np.linalg.inv(pair.K0)
        assert apart(F / np.linalg.norm(F), pair.F) < 1e-12


def test_pairs_are_image_1_with_the_others(tmp_path: Path) -> None:
    dataset = load("hpatches", root=native.write_hpatches(tmp_path), short_side=None)
    assert [pair.identity for pair in dataset][:2] == ["HPatches/i_light/1-2", "HPatches/i_light/1-3"]
    assert [(pair.family, pair.scene) for pair in dataset][4:6] == [
        ("illumination", "i_light"), ("viewpoint", "v_view"),
    ]  # fmt: skip
    assert (len(dataset), dataset.model) == (10, "homography")
    for k, pair in enumerate(list(dataset)[5:], start=2):
        H = native.view(k) / np.linalg.norm(native.view(k))
        np.testing.assert_allclose(pair.H, H, atol=1e-8)
        assert not pair.F.any()
        assert read_image(pair.image0).shape == (*native.VIEW, 3)


def test_homographies_are_of_the_images_as_they_are_read(tmp_path: Path) -> None:
    dataset = load("hpatches", root=native.write_hpatches(tmp_path), sequences=["v_view"], short_side=200)
    for pair in dataset:
        a, b = (read_image(image) for image in (pair.image0, pair.image1))
        assert a.shape[:2] == b.shape[:2] == (200, 300)
        warped = cv2.warpPerspective(a, pair.H, (300, 200)).astype(float)
        inside = cv2.warpPerspective(np.full((200, 300), 255, np.uint8), pair.H, (300, 200))
        seen = cv2.erode(inside, np.ones((9, 9))) > 0
        assert np.abs(warped - b)[seen].mean() < 6  # of 255; a shift by one pixel makes it more than 10


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda f: (f / "3.ppm").unlink(), "no image"),
        (lambda f: (f / "H_1_3").unlink(), "H_1_3: no such file"),
        (lambda f: (f / "H_1_3").write_text("1 0 0\n0 1\n0 0 1\n"), "H_1_3, line 2: 2 columns; it must have 3"),
        (lambda f: (f / "H_1_3").write_text("1 0 0\n0 1 0\n"), "H_1_3: no homography; it must hold three lines"),
        (lambda f: (f / "H_1_3").write_text("1 0 0\n1 0 0\n0 0 1\n"), "H_1_3: no homography"),
    ],
)
def test_one_bad_pair_has_a_problem(damage: object, problem: str, tmp_path: Path) -> None:
    native.write_sequence(tmp_path / "v_view", "0000.jpg", light=False)
    damage(tmp_path / "v_view")  # type: ignore[operator]
    first, second, *_ = load("hpatches", root=tmp_path)
    assert first.problem is None
    assert problem in second.problem
    assert second.H is not None  # still a pair of a homography


def test_folders_without_sequences_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no sequences; it must hold folders i_\* and v_\*"):
        load("hpatches", root=tmp_path)
    native.write_sequence(tmp_path / "v_view", "0000.jpg", light=False)
    with pytest.raises(DataError, match="no sequence 'v_other'; there are: v_view"):
        load("hpatches", root=tmp_path, sequences=["v_other"])


def test_pairs_digest_and_depth(tmp_path: Path) -> None:
    name = native.write_tum(tmp_path, depth=True).name
    dataset, plain = (load("tum", root=tmp_path, sequences=[name], depth=depth) for depth in (True, False))
    part = PairSubset(dataset, [len(dataset) - 1])
    assert isinstance(part, PairDataset)
    assert isinstance(part, DepthDataset)
    assert [pair.identity for pair in part] == [dataset[len(dataset) - 1].identity]
    assert len({part.digest, dataset.digest, PairSubset(dataset, [0]).digest}) == 3
    x = np.array([[40.0, 30.0], [10.0, 70.0]])
    assert np.array_equal(part.depth(part[0].image0, x), dataset.depth(part[0].image0, x), equal_nan=True)
    assert not isinstance(PairSubset(plain, [3, 1]), DepthDataset)
