"""The real stereo pair: its disparity agrees with its pictures and with its F."""

from pathlib import Path

import numpy as np
import pytest

from fmtorch.scenes import StereoPair, skimage_file


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


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"motorcycle_left\.png"):
        StereoPair(root=tmp_path)
    with pytest.raises(FileNotFoundError, match="nothing is downloaded"):
        skimage_file("kidney.tif")
