"""The real stereo pair: its disparity agrees with its pictures and with its F."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from fmtorch.scenes import StereoPair
from fmtorch.scenes.surfaces import skimage_file


def test_one_pair_with_the_protocol() -> None:
    data = StereoPair()
    assert (data.name, len(data)) == ("stereo", 1)
    assert len(data.digest) == 64
    assert [pair.identity for pair in data] == [data[0].identity] == ["stereo/motorcycle/left-right"]
    with pytest.raises(IndexError):
        data[1]


def test_matches_lie_on_the_epipolar_lines() -> None:
    data = StereoPair()
    left, right = data.matches()
    assert len(left) > 200_000
    F = data[0].F
    algebraic = np.einsum("ni,ij,nj->n", np.column_stack([right, np.ones(len(right))]), F,
                          np.column_stack([left, np.ones(len(left))]))  # fmt: skip
    # F is a rotation generator over sqrt 2: the distance to the lines is sqrt 2 times the algebraic error.
    assert np.sqrt(2) * np.abs(algebraic).max() < 1e-9


def test_matches_agree_with_the_pictures() -> None:
    """The disparity maps the left picture onto the right one far better than its mirror or no shift at all."""
    data = StereoPair()
    grey = [cv2.imread(str(image.path), cv2.IMREAD_GRAYSCALE) for image in (data[0].image0, data[0].image1)]
    left, right = data.matches()

    def difference(x: np.ndarray) -> float:
        at = left.astype(int)
        column = np.rint(x[:, 0]).astype(int).clip(0, grey[1].shape[1] - 1)
        there = grey[1][at[:, 1], column].astype(float)
        return float(np.median(np.abs(grey[0][at[:, 1], at[:, 0]].astype(float) - there)))

    assert difference(right) < 4.0  # of 255; exposures differ a little
    assert difference(left) > 3 * difference(right)
    assert difference(2 * left - right) > 3 * difference(right)


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"motorcycle_left\.png"):
        StereoPair(root=tmp_path)
    with pytest.raises(FileNotFoundError, match="nothing is downloaded"):
        skimage_file("kidney.tif")
