"""HPatches' sequences: true homographies of images as they are read, and what one bad pair becomes."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from fmtorch.data import DataError, load, read_image
from tests.data import planes


def test_pairs_are_image_1_with_the_others(tmp_path: Path) -> None:
    dataset = load("hpatches", root=planes.write_hpatches(tmp_path), short_side=None)
    assert [pair.identity for pair in dataset][:2] == ["HPatches/i_light/1-2", "HPatches/i_light/1-3"]
    assert [(pair.family, pair.scene) for pair in dataset][4:6] == [
        ("illumination", "i_light"), ("viewpoint", "v_view"),
    ]  # fmt: skip
    assert len(dataset) == 10
    assert dataset.model == "homography"
    for k, pair in enumerate(list(dataset)[5:], start=2):
        H = planes.view(k) / np.linalg.norm(planes.view(k))
        np.testing.assert_allclose(pair.H, H, atol=1e-8)
        assert not pair.F.any()
        assert read_image(pair.image0).shape == (*planes.SIZE, 3)


def test_homographies_are_of_the_images_as_they_are_read(tmp_path: Path) -> None:
    """Image 0, resized and mapped by H, is image 1, resized."""
    dataset = load("hpatches", root=planes.write_hpatches(tmp_path), sequences=["v_view"], short_side=200)
    for pair in dataset:
        a, b = (read_image(image) for image in (pair.image0, pair.image1))
        assert a.shape[:2] == b.shape[:2] == (200, 300)
        warped = cv2.warpPerspective(a, pair.H, (300, 200)).astype(float)
        seen = (
            cv2.erode(cv2.warpPerspective(np.full((200, 300), 255, np.uint8), pair.H, (300, 200)), np.ones((9, 9))) > 0
        )
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
    planes.write_sequence(tmp_path / "v_view", "0000.jpg", light=False)
    damage(tmp_path / "v_view")  # type: ignore[operator]
    first, second, *_ = load("hpatches", root=tmp_path)
    assert first.problem is None
    assert second.problem is not None
    assert problem in second.problem
    assert second.H is not None  # still a pair of a homography


def test_folders_without_sequences_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no sequences; it must hold folders i_\* and v_\*"):
        load("hpatches", root=tmp_path)
    planes.write_sequence(tmp_path / "v_view", "0000.jpg", light=False)
    with pytest.raises(DataError, match="no sequence 'v_other'; there are: v_view"):
        load("hpatches", root=tmp_path, sequences=["v_other"])
