import numpy as np
import pytest
import torch

from fmtorch.features import FRAME_SIGMAS, HessianDetector
from tests.features.scenes import texture
from tests.reference.local_features import hessian_keypoints


def keypoints(detector: HessianDetector, image: np.ndarray) -> np.ndarray:
    """Rows (x, y, sigma, response)."""
    lafs, scores = detector.detect(image)
    return torch.cat([lafs[:, :, 2], lafs[:, :1, 0] / FRAME_SIGMAS, scores[:, None]], 1).double().numpy()


@pytest.mark.parametrize("levels", [2, 3])
def test_equals_the_definition(levels: int) -> None:
    image = texture(0, 50, 61)
    expected = hessian_keypoints(image / 255, 1e-4, levels)
    found = keypoints(HessianDetector(levels=levels, border=0.0), image)
    assert len(found) == len(expected) > 15
    expected = expected[np.argsort(-expected[:, 3])]
    # float32 filters: rounding of 2^-24 of intensities against differences of about 0.01.
    np.testing.assert_allclose(found[:, :3], expected[:, :3], atol=2e-3)
    np.testing.assert_allclose(found[:, 3], expected[:, 3], rtol=1e-3)


@pytest.mark.parametrize("sigma", [2.2, 3.5, 6.0, 11.0])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_gaussian_blob_has_its_place_and_size(sigma: float, sign: int) -> None:
    # sigma^4 det H of a Gaussian of s, blurred to s^2 + sigma^2, is largest at sigma = s; the detector takes the image
    # to have a blur of 0.5 already.
    y, x = np.mgrid[0:150, 0:170]
    centre = np.array([81.3, 70.6])
    blob = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * sigma**2))
    found = keypoints(HessianDetector(max_features=1), (128 + sign * 100 * blob).round().astype(np.uint8))
    assert len(found) == 1
    np.testing.assert_allclose(found[0, :2], centre, atol=0.05 * sigma)
    # A quadratic over steps of 2^(1/3), kernels cut at 3 sigma, and rounding to 8 bits.
    assert found[0, 2] == pytest.approx(np.hypot(sigma, 0.5), rel=0.06)


def test_at_most_max_features_the_strongest() -> None:
    image = np.tile(texture(1, 60, 60), (2, 3))  # equal blobs: equal scores
    everything, few = HessianDetector().detect(image)[1], HessianDetector(max_features=20).detect(image)[1]
    assert torch.equal(everything, everything.sort(descending=True).values)
    assert torch.equal(few, everything[:20])


def test_of_equal_neighbours_one_remains() -> None:
    # A blob centred between two pixels: their responses are equal in exact arithmetic.
    y, x = np.mgrid[0:60, 0:61]
    blob = np.exp(-((x - 29.5) ** 2 + (y - 30) ** 2) / (2 * 3.0**2))
    found = keypoints(HessianDetector(), (100 + 100 * blob).round().astype(np.uint8))
    assert (np.abs(found[:, :2] - [29.5, 30]) < 0.1).all(1).sum() == 1


def test_border() -> None:
    h, w = 100, 120
    for border in (0.0, 3.0, 6.0):
        x, y, sigma = keypoints(HessianDetector(border=border), texture(2, h, w))[:, :3].T
        room = np.min([x, y, w - 1 - x, h - 1 - y], 0)
        assert (room >= border * sigma - 1e-3).all()
        assert len(room) > 10


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (300, 1), (2, 2), (15, 400), (16, 16), (31, 33)])
@pytest.mark.parametrize("constant", [True, False])
def test_small_and_constant_images(shape: tuple[int, int], constant: bool) -> None:
    image = np.full(shape, 90, np.uint8) if constant else texture(0, 400, 400)[: shape[0], : shape[1]]
    lafs, scores = HessianDetector().detect(image)
    assert lafs.shape == (len(scores), 2, 3)
    if constant or min(shape) < 16:
        assert len(scores) == 0
