import kornia
import numpy as np
import pytest
import torch

from fmtorch.features import ImagePyramid, upright_frames
from tests.features.scenes import random_frames, texture
from tests.reference.local_features import patch


def error(found: torch.Tensor, expected: np.ndarray) -> float:
    """Root mean square difference in grey levels."""
    return float(255 * np.sqrt(np.mean((found.numpy() - expected) ** 2)))


@pytest.mark.parametrize("side", [8.0, 15.0, 24.0, 45.0, 90.0, 160.0])
def test_sees_what_a_camera_would(side: float) -> None:
    # Noise with detail down to a camera's blur: what is not averaged away is aliased.
    image = texture(0, 800, 800, sigma=0.8)
    lafs = random_frames(1, 5, 40, 40, side, side * 1.2)
    lafs[..., 2] += 380
    expected = np.stack([patch(image / 255, laf.double().numpy(), dense=4) for laf in lafs])
    ours = error(ImagePyramid(image).extract(lafs)[:, 0], expected)
    tensor = torch.from_numpy(image)[None, None].float() / 255
    plain = error(kornia.feature.extract_patches_simple(tensor, lafs[None])[0, :, 0], expected)
    peer = error(kornia.feature.extract_patches_from_pyramid(tensor, lafs[None])[0, :, 0], expected)
    print(f"side {side}: ours {ours:.2f}, kornia's pyramid {peer:.2f}, no pyramid {plain:.2f} grey levels")
    assert ours < 1.05 * peer
    if side > 40:
        assert ours < 0.3 * plain


def test_small_frames_are_kornias_patches() -> None:
    # Where pixels of the patch are denser than the image's, both interpolate the image itself.
    image, lafs = texture(0), random_frames(0, 30, 160, 200, 3, 14)
    lafs = torch.cat([lafs[..., :2] * 0.8, lafs[..., 2:]], -1)
    tensor = torch.from_numpy(image)[None, None].float() / 255
    expected = kornia.feature.extract_patches_simple(tensor, lafs[None])[0]
    torch.testing.assert_close(ImagePyramid(image).extract(lafs), expected, atol=2e-4, rtol=0)


def test_neighbours_are_invisible() -> None:
    image, lafs = texture(4), random_frames(4, 40, 160, 200)
    lafs[7] = torch.nan
    lafs[9, 0, 0] = torch.inf
    together = ImagePyramid(image).extract(lafs)
    assert torch.isfinite(together).all()
    assert not together[[7, 9]].any()
    for i in (0, 8, 39):
        assert torch.equal(ImagePyramid(image).extract(lafs[i : i + 1])[0], together[i])
    assert ImagePyramid(image).extract(lafs[:0]).shape == (0, 1, 32, 32)


@pytest.mark.parametrize("shape", [(1, 1), (1, 90), (70, 1), (5, 7), (31, 33)])
def test_small_images_continue_at_their_border(shape: tuple[int, int]) -> None:
    flat = np.full(shape, 51, np.uint8)
    lafs = upright_frames(torch.tensor([[0.0, 0.0], [3.0, 2.0]]), torch.tensor([1.0, 40.0]))
    torch.testing.assert_close(ImagePyramid(flat).extract(lafs), torch.full((2, 1, 32, 32), 0.2))


def test_pixel_x_of_a_level_is_pixel_2x_of_the_finer_one() -> None:
    y, x = np.mgrid[0:100, 0:150]
    ramp = (x + y).astype(np.uint8)
    for level, image in enumerate(ImagePyramid(ramp).levels):
        inner = image[3:-3, 3:-3] if min(image.shape) > 8 else image[:0]
        expected = ramp[:: 2**level, :: 2**level][3:-3, 3:-3][: len(inner)] / 255
        np.testing.assert_allclose(inner, expected, rtol=1e-5, atol=1e-6)
