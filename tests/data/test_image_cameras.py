"""Cameras of photographs by name: COLMAP's models and JSON files."""

import json
from pathlib import Path

import pytest

from fmtorch.data import DataError, ImageCameras, Lens
from tests.data.native import SIZE, to_binary, write_colmap


@pytest.mark.parametrize("binary", [False, True])
def test_a_model_by_its_folder_and_by_its_file(binary: bool, tmp_path: Path) -> None:
    images = write_colmap(tmp_path) / "images"
    sparse = tmp_path / "sparse" / "0"
    if binary:
        to_binary(sparse)
    for path in (sparse, sparse / ("cameras.bin" if binary else "cameras.txt")):
        cameras = ImageCameras(path)
        assert cameras.of(images / "00.png") == (Lens(40.0, 40.0, 15.5, 11.5, "SIMPLE_PINHOLE"), SIZE)
        lens, _ = cameras.of(images / "02.png")
        assert (lens.model, lens.bends) == ("OPENCV", True)
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


def test_no_such_model(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"neither cameras\.bin nor cameras\.txt"):
        ImageCameras(tmp_path)
