import kornia
import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.features import (
    ImagePyramid,
    NetworkOrientation,
    NetworkShape,
    dominant_gradient,
    frame_scale,
    make_upright,
    rotate_frames,
)
from tests.conftest import oracle, shared_path
from tests.features.scenes import random_frames, texture
from tests.reference.local_features import dominant_gradient as reference_orientation


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    return ((a - b + np.pi) % (2 * np.pi) - np.pi).abs()


def test_frame_algebra_is_kornias() -> None:
    lafs = random_frames(0, 50, 100, 100)
    torch.testing.assert_close(frame_scale(lafs), kornia.feature.get_laf_scale(lafs[None])[0, :, 0, 0])
    torch.testing.assert_close(make_upright(lafs), kornia.feature.make_upright(lafs[None])[0], rtol=1e-4, atol=1e-4)
    angle = torch.linspace(-3, 3, 50)
    turned = kornia.feature.rotate_laf(lafs[None], torch.rad2deg(angle)[None, :, None])[0]
    torch.testing.assert_close(rotate_frames(lafs, angle), turned, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(make_upright(turned), make_upright(lafs), rtol=1e-4, atol=1e-3)


def test_orientation_equals_the_definition() -> None:
    patches = ImagePyramid(texture(0)).extract(random_frames(0, 25, 160, 200))
    expected = torch.tensor([reference_orientation(p[0].double().numpy()) for p in patches])
    assert angle_between(dominant_gradient(patches), expected).max() < 1e-4


def test_orientation_turns_with_the_patch() -> None:
    patches = ImagePyramid(texture(2)).extract(random_frames(2, 100, 160, 200))
    turned = dominant_gradient(patches.rot90(1, (2, 3)))  # counter-clockwise
    assert (angle_between(turned, dominant_gradient(patches) + np.pi / 2) < 1e-3).float().mean() > 0.97
    flat = dominant_gradient(torch.full((2, 1, 32, 32), 0.3))
    assert torch.isfinite(flat).all()


@pytest.mark.parametrize("part", [NetworkShape, NetworkOrientation])
def test_no_frames(part: type) -> None:
    def network(patches: Tensor) -> Tensor:
        raise AssertionError("called without patches")

    assert part(network)(ImagePyramid(texture(0)), torch.zeros(0, 2, 3)).shape == (0, 2, 3)
    assert dominant_gradient(torch.zeros(0, 1, 32, 32)).shape == (0,)


def test_shape_is_composed_as_kornias() -> None:
    # The same numbers for a frame through both: kornia's network is replaced by one that gives known numbers.
    lafs = random_frames(5, 64, 160, 200)
    numbers = torch.empty(64, 3).uniform_(-0.4, 0.4, generator=torch.Generator().manual_seed(0))
    peer = kornia.feature.LAFAffNetShapeEstimator(False, preserve_orientation=False).eval()
    peer.features = torch.nn.Sequential(Constant(numbers))
    image = texture(5)
    expected = peer(lafs[None], torch.from_numpy(image)[None, None].float() / 255)[0]
    found = NetworkShape(lambda patches: numbers)(ImagePyramid(image), lafs)
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(frame_scale(found), frame_scale(lafs), rtol=1e-4, atol=1e-4)


class Constant(torch.nn.Module):
    def __init__(self, value: Tensor) -> None:
        super().__init__()
        self.value = value

    def forward(self, patches: Tensor) -> Tensor:
        return self.value[: len(patches)]


def test_impossible_shapes_keep_the_frame() -> None:
    lafs = random_frames(6, 5, 160, 200)
    bad = torch.tensor([[0.1, 0, 0], [-1, 0, 0], [torch.nan, 0, 0], [0, 50, 0], [0.8, 0, -0.9]])
    found = NetworkShape(lambda patches: bad)(ImagePyramid(texture(6)), lafs)
    torch.testing.assert_close(found[1:], make_upright(lafs)[1:])
    assert not torch.allclose(found[0], make_upright(lafs)[0])


def test_orientation_network_turns_by_its_vector() -> None:
    lafs = random_frames(7, 3, 160, 200)
    vectors = torch.tensor([[0.0, 0.3], [0.5, 0.0], [0.1, -0.1]])
    found = NetworkOrientation(lambda patches: vectors)(ImagePyramid(texture(7)), lafs)
    expected = rotate_frames(lafs, torch.tensor([0.0, np.pi / 2, 0.75 * np.pi]))
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


def authors(name: str) -> torch.nn.Module:
    weights = torch.load(shared_path(f"weights/{name}.pth"), weights_only=True, map_location="cpu")["state_dict"]
    kinds = {"AffNet": kornia.feature.LAFAffNetShapeEstimator, "OriNet": kornia.feature.OriNet}
    module = kinds[name](False).eval()
    module.load_state_dict(weights)
    return module


def test_authors_networks_give_the_stored_frames() -> None:
    file = oracle("affnet_orinet.npz")
    images = oracle("sift.npz")
    affnet, orinet = authors("AffNet"), authors("OriNet")

    @torch.no_grad()
    def shape(patches: Tensor) -> Tensor:
        return affnet.features(affnet._normalize_input(patches)).flatten(1)

    @torch.no_grad()
    def orientation(patches: Tensor) -> Tensor:
        return orinet.features(orinet._normalize_input(patches)).flatten(1)

    gaps = []
    for number in (0, 1):
        chosen = file["keypoints"][:, 4] == number
        image = images[f"{number:03d}.image"]
        lafs = torch.from_numpy(file["laf_in"][chosen]).float()
        stored = torch.from_numpy(file["laf_affnet"][chosen]).float()
        turned = torch.from_numpy(file["laf_oriented"][chosen]).float()
        # Through kornia's patches, the stored frames. Entries of up to 100 px in float32 through a network.
        torch.testing.assert_close(NetworkShape(shape)(KorniaPyramid(image), lafs), stored, atol=5e-3, rtol=1e-3)
        oriented = NetworkOrientation(orientation)(KorniaPyramid(image), stored)
        torch.testing.assert_close(oriented, turned, atol=5e-3, rtol=1e-3)
        # Through ours, which are blurred otherwise, nearly so.
        found = NetworkShape(shape)(ImagePyramid(image), lafs)
        gaps.append((found - stored)[..., :2].abs().amax((1, 2)) / frame_scale(lafs))
    assert torch.cat(gaps).median() < 0.05


class KorniaPyramid(ImagePyramid):
    def extract(self, lafs: Tensor, size: int = 32) -> Tensor:
        return kornia.feature.extract_patches_from_pyramid(self.levels[0][None, None], lafs[None], size)[0]
