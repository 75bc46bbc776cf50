import numpy as np
import pytest
import torch

from fmtorch.features import SIFT, ImagePyramid, PatchSIFT, RootSIFTPCA, learn_projection, root_sift, sift_of_patches
from fmtorch.features.sift import project
from tests.conftest import oracle
from tests.features.scenes import random_frames, texture
from tests.reference.local_features import sift


def test_equals_the_definition() -> None:
    patches = ImagePyramid(texture(0)).extract(random_frames(0, 20, 160, 200))
    expected = np.stack([sift(p[0].double().numpy()) for p in patches])
    np.testing.assert_allclose(sift_of_patches(patches), expected, atol=2e-5)


@pytest.mark.parametrize("number", ["000", "001"])
def test_resembles_opencvs_descriptors(number: str) -> None:
    file = oracle("sift.npz")
    image = file[f"{number}.image"]
    found = SIFT()(image)
    ours = PatchSIFT()(ImagePyramid(image), found.lafs)
    theirs = found.descriptors / found.descriptors.norm(dim=1, keepdim=True)
    cosine = (ours * theirs).sum(1)
    assert cosine.median() > 0.99
    assert cosine.quantile(0.05) > 0.95


def test_domain_sizes_are_averaged() -> None:
    pyramid, lafs = ImagePyramid(texture(1)), random_frames(1, 30, 160, 200)
    pooled = PatchSIFT(smallest=0.5, largest=2.0, sizes=4)(pyramid, lafs)
    single = []
    for size in (0.5, 1.0, 1.5, 2.0):
        scaled = lafs.clone()
        scaled[..., :2] *= size
        single.append(PatchSIFT()(pyramid, scaled))
    mean = torch.stack(single).mean(0)
    torch.testing.assert_close(pooled, mean / mean.norm(dim=1, keepdim=True))
    root = PatchSIFT(root=True)(pyramid, lafs)
    torch.testing.assert_close(root, root_sift(PatchSIFT()(pyramid, lafs)))


def test_unaffected_by_light_and_neighbours() -> None:
    patches = ImagePyramid(texture(3)).extract(random_frames(3, 150, 160, 200))
    together = sift_of_patches(patches)
    torch.testing.assert_close(sift_of_patches(0.3 * patches + 0.2), together, atol=1e-4, rtol=0)
    torch.testing.assert_close(sift_of_patches(patches[70:71]), together[70:71], atol=1e-5, rtol=0)
    flat = sift_of_patches(torch.full((2, 1, 32, 32), 0.5))
    assert not flat.any()
    assert sift_of_patches(patches[:0]).shape == (0, 128)


def test_projection_keeps_the_variance() -> None:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(3000, 128, generator=generator) * torch.linspace(2, 0.01, 128) + 1
    mean, basis = learn_projection(x, 20)
    torch.testing.assert_close(mean, x.mean(0), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(basis.T @ basis, torch.eye(20), atol=1e-5, rtol=0)
    variance = ((x - mean) @ basis).var(0)
    assert (variance.diff() < 0).all()
    singular = torch.linalg.svdvals(x - x.mean(0))[:20].square() / (len(x) - 1)
    torch.testing.assert_close(variance, singular, rtol=1e-3, atol=0)
    projected = project(x, mean, basis, 0.5)
    torch.testing.assert_close(projected.norm(dim=1), torch.ones(len(x)))
    plain = (x - mean) @ basis
    assert torch.equal(projected.sign(), plain.sign())
    torch.testing.assert_close(projected[0].square() / projected[0, 0] ** 2, plain[0].abs() / plain[0, 0].abs())


def test_a_projection_that_is_absent_or_broken(tmp_path: object) -> None:
    from pathlib import Path

    folder = Path(str(tmp_path))
    pyramid, lafs = ImagePyramid(texture(5)), random_frames(5, 2, 160, 200)
    with pytest.raises(FileNotFoundError, match=r"absent\.npz.*make_models"):
        RootSIFTPCA(model=folder / "absent.npz")(pyramid, lafs)
    (folder / "text.npz").write_text("no projection")
    np.savez(folder / "shape.npz", mean=np.zeros(5), basis=np.zeros((128, 80)))
    np.savez(folder / "names.npz", average=np.zeros(128))
    for name in ("text", "shape", "names"):
        with pytest.raises(ValueError, match=rf"{name}\.npz.*make_models"):
            RootSIFTPCA(model=folder / f"{name}.npz")(pyramid, lafs)
