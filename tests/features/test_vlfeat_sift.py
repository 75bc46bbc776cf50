"""VLFeat's SIFT: frames of blobs, turned images, what OpenCV finds at the same places, bad images."""

import cv2
import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.features import FRAME_SIGMAS, SIFT, VLFeatSIFT
from tests.features.scenes import texture

pytest.importorskip("pycolmap", reason="extra colmap is not installed")


def blob(x: float, y: float, sigma: float, h: int = 120, w: int = 160) -> np.ndarray:
    v, u = np.mgrid[:h, :w]
    return np.rint(30 + 200 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma**2))).astype(np.uint8)


@pytest.mark.parametrize(("x", "y", "sigma"), [(80.0, 60.0, 4.0), (71.3, 48.8, 6.0)])
def test_a_blob_is_found_where_it_is(x: float, y: float, sigma: float) -> None:
    found = VLFeatSIFT(peak_threshold=0.01)(blob(x, y, sigma))
    assert len(found.lafs)
    nearest = (found.keypoints - torch.tensor([x, y])).norm(dim=1).argmin()
    assert (found.keypoints[nearest] - torch.tensor([x, y])).abs().max() < 0.1
    # A Gaussian's difference of Gaussians, blurred by s and 2^(1/3) s, is largest at s = sigma 2^(-1/6).
    assert found.scores[nearest].item() == pytest.approx(sigma * 2 ** (-1 / 6), rel=0.1)
    half_side = found.lafs[nearest, :, 0].norm().item()
    assert half_side == pytest.approx(FRAME_SIGMAS * found.scores[nearest].item(), rel=1e-5)


def test_frames_turn_with_the_image() -> None:
    image = texture(3, 120, 160)
    upright, turned = VLFeatSIFT(peak_threshold=0.01)(image), VLFeatSIFT(peak_threshold=0.01)(np.rot90(image))
    matrix, shift = torch.tensor([[0.0, 1.0], [-1.0, 0.0]]), torch.tensor([0.0, image.shape[1] - 1.0])
    expected = matrix @ upright.lafs
    expected[..., 2] += shift
    gaps = (expected[:, None] - turned.lafs[None]).abs().amax((2, 3)).amin(1)
    assert len(expected) > 50
    assert (gaps < 0.05).float().mean() > 0.95


def test_agrees_with_opencv_where_both_find_a_keypoint() -> None:
    image = cv2.resize(texture(5), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    ours, opencv = VLFeatSIFT(peak_threshold=0.005)(image), SIFT()(image)
    distance, i = torch.cdist(opencv.keypoints, ours.keypoints).min(1)
    near = distance < 0.3
    assert near.sum() > 30
    a, b = ours.lafs[i[near]], opencv.lafs[near]
    assert (a - b)[..., 2].median(0).values.abs().max() < 0.05
    assert ((a[..., 0] - b[..., 0]).norm(dim=1) / b[..., 0].norm(dim=1)).median() < 0.1
    between = (ours.descriptors[i[near]] - opencv.descriptors[near]).norm(dim=1)
    assert between.median() < 0.3 * 512  # of vectors of length 512


def test_the_preset_names_it() -> None:
    assert presets.build("features", "sift_vlfeat", max_features=50) == VLFeatSIFT(max_features=50)
