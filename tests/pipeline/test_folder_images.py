import itertools
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from fmtorch.pipeline import chosen_pairs, images_below
from fmtorch.pipeline.folder import default_output, in_blocks, natural_order


def picture(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.zeros((4, 4), np.uint8))
    return path


def text(path: Path, value: str = "{}") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(value)


def test_nothing_that_fmtorch_has_written_is_a_photograph(tmp_path: Path) -> None:
    photographs = [picture(tmp_path / name) for name in ("a.jpg", "b.png", "more/c.tif", "more/matches.png")]
    for name in ("matches.png", "pruning.png", "epipolar.png"):
        picture(tmp_path / "matches/a-b" / name)
        picture(tmp_path / name)  # output=.
    for folder in ("matches/a-b", "."):
        text(tmp_path / folder / "result.json")
    picture(tmp_path / "set/scene/Images/00000000.jpg")  # an undistorted copy
    text(tmp_path / "set/pairs.json")
    picture(tmp_path / ".thumbnails/a.jpg")
    assert images_below(tmp_path) == sorted(photographs)
    assert images_below(tmp_path / "matches/..") != []


def test_a_set_of_pairs_may_be_asked_for(tmp_path: Path) -> None:
    text(tmp_path / "pairs.json")
    images = [picture(tmp_path / f"scene/Images/{i}.jpg") for i in range(2)]
    assert images_below(tmp_path) == images


def test_only_regular_files_are_images(tmp_path: Path) -> None:
    images = [picture(tmp_path / "a.jpg"), picture(tmp_path / "b.jpg")]
    os.mkfifo(tmp_path / "c.jpg")
    (tmp_path / "d.jpg").symlink_to("/dev/zero")
    assert images_below(tmp_path) == images


def test_sequential_pairs_follow_the_natural_order_of_names(tmp_path: Path) -> None:
    for i in (1, 2, 9, 10, 11):
        picture(tmp_path / f"frame{i}.jpg")
    images = images_below(tmp_path)
    pairs = chosen_pairs(tmp_path, images, Path("sequential:2"))
    numbers = [tuple(int(image.stem.removeprefix("frame")) for image in pair) for pair in pairs]
    assert numbers == [(1, 2), (1, 9), (2, 9), (2, 10), (9, 10), (9, 11), (10, 11)]
    assert len(chosen_pairs(tmp_path, images, Path("sequential:100"))) == 10


@pytest.mark.parametrize("pairs", ["sequential", "sequential:0", "sequential:-1", "sequential:x", "sequential:1.5"])
def test_a_wrong_number_of_neighbours_is_told(pairs: str, tmp_path: Path) -> None:
    images = [picture(tmp_path / "a.jpg"), picture(tmp_path / "b.jpg")]
    with pytest.raises(ValueError, match="it must be sequential:N with a whole number N of at least 1"):
        chosen_pairs(tmp_path, images, Path(pairs))


def test_natural_order() -> None:
    names = ["b2", "B10", "a", "a1", "a01", "10", "9", "9a"]
    assert sorted(names, key=natural_order) == ["9", "9a", "10", "a", "a01", "a1", "b2", "B10"]


def test_blocks_hold_few_images_at_a_time() -> None:
    images = [Path(f"{i}.jpg") for i in range(100)]
    pairs = list(itertools.combinations(images, 2))
    assert in_blocks(pairs[:3], 100) == pairs[:3]
    ordered = in_blocks(pairs, 10)
    assert sorted(ordered) == sorted(pairs)
    held: dict[Path, None] = {}
    loaded = 0
    for pair in ordered:
        for image in pair:
            loaded += image not in held
            held.pop(image, None)
            held[image] = None
        for image in list(held)[:-12]:
            del held[image]
    assert loaded <= 100 * 10 / 2 + 100  # once for each of ten blocks, of which half come after it


def test_folders_of_one_name_have_outputs_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert default_output(tmp_path / "x/photos") == Path("matches/photos")
    text(tmp_path / "matches/photos/export.json", json.dumps({"images": str(tmp_path / "x/photos")}))
    assert default_output(Path("x/photos")) == Path("matches/photos")
    other = default_output(tmp_path / "y/photos")
    assert other.name.startswith("photos-")
    assert other != default_output(tmp_path / "z/photos")
