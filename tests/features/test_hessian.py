"""Detection by the Hessian, and orientation of frames."""

import kornia
import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch import features
from fmtorch.features import hessian, networks
from tests.conftest import oracle, shared_path
from tests.features.scenes import random_frames, texture
from tests.reference.local_features import dominant_gradient as reference_orientation
from tests.reference.local_features import hessian_keypoints


def keypoints(detector: features.HessianDetector, image: np.ndarray) -> np.ndarray:
    """Rows (x, y, sigma, response)."""
    lafs, scores = detector.detect(image)
    return torch.cat([lafs[:, :, 2], lafs[:, :1, 0] / features.FRAME_SIGMAS, scores[:, None]], 1).double().numpy()


@pytest.mark.parametrize("levels", [2, 3])
def test_equals_the_definition(levels: int) -> None:
    image = texture(0, hessian.STRIP + 11, 61)  # worked on in two strips
    expected = hessian_keypoints(image / 255, 1e-4, levels)
    found = keypoints(features.HessianDetector(levels=levels, border=0.0), image)
    assert len(found) == len(expected) > 15
    expected = expected[np.argsort(-expected[:, 3])]
    # float32 filters: rounding of 2^-24 of intensities against differences of about 0.01.
    np.testing.assert_allclose(found[:, :3], expected[:, :3], atol=2e-3)
    np.testing.assert_allclose(found[:, 3], expected[:, 3], rtol=1e-3)


def test_of_equal_neighbours_one_remains() -> None:
    # A blob centred between two pixels: their responses are equal in exact arithmetic.
    y, x = np.mgrid[0:60, 0:61]
    blob = np.exp(-((x - 29.5) ** 2 + (y - 30) ** 2) / (2 * 3.0**2))
    found = keypoints(features.HessianDetector(), (100 + 100 * blob).round().astype(np.uint8))
    assert (np.abs(found[:, :2] - [29.5, 30]) < 0.1).all(1).sum() == 1


def test_border() -> None:
    h, w = 100, 120
    for border in (0.0, 3.0, 6.0):
        x, y, sigma = keypoints(features.HessianDetector(border=border), texture(2, h, w))[:, :3].T
        room = np.min([x, y, w - 1 - x, h - 1 - y], 0)
        assert (room >= border * sigma - 1e-3).all()
        assert len(room) > 10


def test_frame_algebra_is_kornias() -> None:
    lafs = random_frames(0, 50, 100, 100)
    torch.testing.assert_close(features.frame_scale(lafs), kornia.feature.get_laf_scale(lafs[None])[0, :, 0, 0])
    upright = kornia.feature.make_upright(lafs[None])[0]
    torch.testing.assert_close(features.make_upright(lafs), upright, rtol=1e-4, atol=1e-4)
    angle = torch.linspace(-3, 3, 50)
    turned = kornia.feature.rotate_laf(lafs[None], torch.rad2deg(angle)[None, :, None])[0]
    torch.testing.assert_close(features.rotate_frames(lafs, angle), turned, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(features.make_upright(turned), features.make_upright(lafs), rtol=1e-4, atol=1e-3)


def test_orientation_equals_the_definition() -> None:
    patches = features.ImagePyramid(texture(0)).extract(random_frames(0, 25, 160, 200))
    expected = torch.tensor([reference_orientation(p[0].double().numpy()) for p in patches])
    differences = (features.dominant_gradient(patches) - expected + np.pi) % (2 * np.pi) - np.pi
    assert differences.abs().max() < 1e-4
    assert torch.isfinite(features.dominant_gradient(torch.full((2, 1, 32, 32), 0.3))).all()


@pytest.mark.parametrize("part", [features.NetworkShape, features.NetworkOrientation])
def test_no_frames(part: type) -> None:
    def network(patches: Tensor) -> Tensor:
        raise AssertionError("called without patches")

    assert part(network)(features.ImagePyramid(texture(0)), torch.zeros(0, 2, 3)).shape == (0, 2, 3)
    assert features.dominant_gradient(torch.zeros(0, 1, 32, 32)).shape == (0,)


def test_shape_is_composed_as_kornias() -> None:
    # The same numbers for a frame through both: kornia's network is replaced by one that gives known numbers.
    lafs = random_frames(5, 64, 160, 200)
    numbers = torch.empty(64, 3).uniform_(-0.4, 0.4, generator=torch.Generator().manual_seed(0))
    peer = kornia.feature.LAFAffNetShapeEstimator(False, preserve_orientation=False).eval()
    del peer.features
    peer.features = lambda patches: numbers
    image = texture(5)
    expected = peer(lafs[None], torch.from_numpy(image)[None, None].float() / 255)[0]
    found = features.NetworkShape(lambda patches: numbers)(features.ImagePyramid(image), lafs)
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(features.frame_scale(found), features.frame_scale(lafs), rtol=1e-4, atol=1e-4)


def test_impossible_shapes_keep_the_frame() -> None:
    lafs = random_frames(6, 5, 160, 200)
    bad = torch.tensor([[0.1, 0, 0], [-1, 0, 0], [torch.nan, 0, 0], [0, 50, 0], [0.8, 0, -0.9]])
    found = features.NetworkShape(lambda patches: bad)(features.ImagePyramid(texture(6)), lafs)
    torch.testing.assert_close(found[1:], features.make_upright(lafs)[1:])
    assert not torch.allclose(found[0], features.make_upright(lafs)[0])


def test_orientation_network_turns_by_its_vector() -> None:
    lafs = random_frames(7, 3, 160, 200)
    vectors = torch.tensor([[0.0, 0.3], [0.5, 0.0], [0.1, -0.1]])
    found = features.NetworkOrientation(lambda patches: vectors)(features.ImagePyramid(texture(7)), lafs)
    expected = features.rotate_frames(lafs, torch.tensor([0.0, np.pi / 2, 0.75 * np.pi]))
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


def test_authors_networks_give_the_stored_frames() -> None:
    file = oracle("affnet_orinet.npz")
    images = oracle("sift.npz")
    shape, orientation = (networks.build(name).eval() for name in ("affnet", "orinet"))
    networks.load_weights(shape, shared_path("weights/AffNet.pth"))
    networks.load_weights(orientation, shared_path("weights/OriNet.pth"))
    gaps = []
    for number in (0, 1):
        chosen = file["keypoints"][:, 4] == number
        image = images[f"{number:03d}.image"]
        lafs = torch.from_numpy(file["laf_in"][chosen]).float()
        stored = torch.from_numpy(file["laf_affnet"][chosen]).float()
        turned = torch.from_numpy(file["laf_oriented"][chosen]).float()
        # Through kornia's patches, the stored frames. Entries of up to 100 px in float32 through a network.
        shaped = features.NetworkShape(shape)(KorniaPyramid(image), lafs)
        torch.testing.assert_close(shaped, stored, atol=5e-3, rtol=1e-3)
        oriented = features.NetworkOrientation(orientation)(KorniaPyramid(image), stored)
        torch.testing.assert_close(oriented, turned, atol=5e-3, rtol=1e-3)
        # Through ours, which are blurred otherwise, nearly so.
        found = features.NetworkShape(shape)(features.ImagePyramid(image), lafs)
        gaps.append((found - stored)[..., :2].abs().amax((1, 2)) / features.frame_scale(lafs))
    assert torch.cat(gaps).median() < 0.05


class KorniaPyramid(features.ImagePyramid):
    def extract(self, lafs: Tensor, size: int = 32) -> Tensor:
        return kornia.feature.extract_patches_from_pyramid(self.levels[0][None, None], lafs[None], size)[0]
