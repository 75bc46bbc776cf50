"""Results show themselves in a line and a picture, and are kept in files that hold no code."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import torch

import fmtorch
from fmtorch import data
from tests.laws import scene


@pytest.fixture(scope="module")
def result() -> fmtorch.MatchResult:
    pair = data.load("stereo")[0]
    images = [PIL.Image.fromarray(data.read_image(image)) for image in (pair.image0, pair.image1)]
    return fmtorch.match(*images, pipeline="sift_fmtorch", longest_side=400)


def test_a_result_is_one_line_and_a_picture_in_a_notebook(result: fmtorch.MatchResult) -> None:
    assert repr(result).startswith(f"MatchResult({len(result.inliers)} matches, {int(result.inliers.sum())} inliers")
    assert len(repr(result)) < 120
    assert "data:image/jpeg;base64," in result._repr_html_()


def test_a_result_draws_itself(result: fmtorch.MatchResult) -> None:
    pictures = [result.draw(what) for what in ("matches", "pruning", "epipolar")]
    assert all(picture.dtype == np.uint8 and picture.shape[2] == 3 for picture in pictures)
    assert not np.array_equal(pictures[0], pictures[1])


def test_a_result_is_saved_as_the_command_saves_it(result: fmtorch.MatchResult, tmp_path: Path) -> None:
    names = result.save(tmp_path / "out", report={"note": "mine"})
    assert sorted(names) == sorted(path.name for path in (tmp_path / "out").iterdir())
    stored = json.loads((tmp_path / "out" / "result.json").read_text())
    assert np.array_equal(stored["F"], result.F)
    assert stored["note"] == "mine"
    picture = cv2.imread(str(tmp_path / "out" / "matches.png"))
    assert np.array_equal(picture[..., ::-1], result.draw())


def test_pillow_images_are_arrays(result: fmtorch.MatchResult) -> None:
    pair = data.load("stereo")[0]
    again = fmtorch.match(
        *(data.read_image(image) for image in (pair.image0, pair.image1)), pipeline="sift_fmtorch", longest_side=400
    )
    assert torch.equal(again.F, result.F)
    with pytest.raises(ValueError, match="image0 is a Pillow image of mode F; it must be of 8 bits"):
        fmtorch.match(PIL.Image.new("F", (9, 9)), PIL.Image.new("L", (9, 9)))


def test_matches_and_epipolar_lines_are_drawn_of_what_find_fundamental_takes_and_gives(tmp_path: Path) -> None:
    c = scene(0, 60)
    path = tmp_path / "a.png"
    PIL.Image.new("RGB", (960, 640)).save(path)
    estimate = fmtorch.find_fundamental(c.x0, c.x1)
    image = np.zeros((640, 960), np.uint8)
    drawn = fmtorch.draw_matches(path, image, c.x0, c.x1, estimate.inliers)
    assert np.array_equal(drawn, fmtorch.draw_matches(image, image, c.x0[0].numpy(), c.x1[0], estimate.inliers[0]))
    lines = fmtorch.draw_epipolar_lines(path, image, c.x0[0], c.x1[0], estimate.F)
    assert lines.any()
    with pytest.raises(ValueError, match=r"x0 has shape \(3, 60\); it must be \(N, 2\)"):
        fmtorch.draw_matches(image, image, np.zeros((3, 60)), c.x1[0])


def test_estimates_are_one_line_and_a_table_of_pairs() -> None:
    c = scene(0, 60)
    estimate = fmtorch.find_fundamental([c.x0[0], c.x0[0, :5]], [c.x1[0], c.x1[0, :5]])
    assert repr(estimate[0]).startswith(f"Estimate(fundamental, {int(estimate.inliers.sum())} inliers, significance")
    assert repr(estimate[1]) == f"Estimate(no fundamental matrix: {estimate.reason[1]})"
    assert repr(estimate).startswith("Estimate(2 pairs: 1 ok, 1 related, 0 to ")
    assert estimate._repr_html_().count("<tr>") == 3
    assert len(repr(c)) < 500


def test_a_record_is_the_same_after_its_file(tmp_path: Path) -> None:
    c = scene(0, 60)
    K = torch.tensor([[800.0, 0, 480], [0, 800, 320], [0, 0, 1]])
    estimate = fmtorch.find_essential(c.x0, c.x1, K, K, covariance=True, pair_type=True)
    path = tmp_path / "estimate.safetensors"
    estimate.save(path)
    for kind in (fmtorch.Estimate, fmtorch.PoseEstimate):
        again = kind.load(path)
        assert again.reason == estimate.reason
        for name, value in vars(estimate).items():
            if torch.is_tensor(value):
                torch.testing.assert_close(getattr(again, name), value, rtol=0, atol=0, equal_nan=True)
    with pytest.raises(ValueError, match=r"holds PoseEstimate; Correspondences\.load reads Correspondences"):
        fmtorch.Correspondences.load(path)


def test_a_file_with_code_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "estimate.pt"
    path.write_bytes(pickle.dumps(print))
    with pytest.raises(ValueError, match=r"estimate\.pt is no file that save\(\) wrote"):
        fmtorch.Estimate.load(path)
