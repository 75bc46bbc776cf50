import cv2
import kornia
import numpy as np
import pytest
import torch

from fmtorch.features import FRAME_SIGMAS, SIFT, keypoints_to_lafs, root_sift
from tests.conftest import oracle
from tests.features.scenes import texture


@pytest.mark.parametrize("number", ["000", "001"])
@pytest.mark.parametrize("case", ["default", "n1000_ct02"])
def test_equals_stored_keypoints(number: str, case: str) -> None:
    file = oracle("sift.npz")
    options = {"default": (8000, 0.04), "n1000_ct02": (1000, 0.02)}[case]
    found = SIFT(*options, precise_upscale=False)(file[f"{number}.image"])
    expected = {name: file[f"{number}.{case}.{name}"] for name in ("xy", "size", "angle", "response", "desc")}
    np.testing.assert_array_equal(found.keypoints, expected["xy"])
    np.testing.assert_array_equal(found.scores, expected["response"])
    # OpenCV rounds to whole numbers what it sums in vectors of the processor's width: relative errors of 1e-7 of up to
    # 255 are some 3e-5, and so cross a half in 6e-5 of the entries.
    difference = np.abs(found.descriptors.numpy() - expected["desc"])
    assert difference.max() <= 1
    assert np.count_nonzero(difference) < 1e-4 * difference.size
    assert found.image_size.tolist() == [512, 768]
    # Frames through kornia's own readers; angles in degrees carry a float32 rounding of about 2e-5.
    scale = kornia.feature.get_laf_scale(found.lafs[None])[0, :, 0, 0]
    np.testing.assert_allclose(scale, FRAME_SIGMAS * expected["size"] / 2, rtol=1e-6)
    angle = kornia.feature.get_laf_orientation(found.lafs[None])[0, :, 0]
    difference = (angle.numpy() + expected["angle"] + 180) % 360 - 180
    assert np.abs(difference).max() < 1e-3


def test_frame_axis_points_along_opencvs_angle() -> None:
    laf = keypoints_to_lafs([cv2.KeyPoint(10.0, 20.0, 4.0, 90.0)])[0]  # 90 degrees in OpenCV: down the image
    torch.testing.assert_close(laf[:, 0], torch.tensor([0.0, 12.0]), atol=1e-5, rtol=0)
    torch.testing.assert_close(laf[:, 1], torch.tensor([-12.0, 0.0]), atol=1e-5, rtol=0)
    assert laf[:, 2].tolist() == [10.0, 20.0]


def test_frames_turn_with_the_image() -> None:
    # Turning an image by 90 degrees maps (x, y) to (y, w - 1 - x); frames must follow. OpenCV rounds the upright
    # direction into 36 bins, which 90 degrees respects; the blurred pyramid is symmetric up to float rounding.
    image = texture(3)
    upright, turned = SIFT()(image), SIFT()(np.rot90(image))
    matrix, shift = torch.tensor([[0.0, 1.0], [-1.0, 0.0]]), torch.tensor([0.0, image.shape[1] - 1.0])
    expected = matrix @ upright.lafs
    expected[..., 2] += shift
    gaps = (expected[:, None] - turned.lafs[None]).abs().amax((2, 3)).amin(1)
    assert (gaps < 0.1).float().mean() > 0.9


def test_root_sift_compares_by_hellinger() -> None:
    plain, root = SIFT()(texture(1)), SIFT(root=True)(texture(1))
    torch.testing.assert_close(root.descriptors.square() * plain.descriptors.sum(-1, keepdim=True), plain.descriptors)
    torch.testing.assert_close(root.descriptors.norm(dim=-1), torch.ones(len(root)))
    assert not root_sift(torch.zeros(1, 128)).any()
