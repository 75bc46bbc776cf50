"""DISK and ALIKED behind the project's conventions; untrained networks, and probes whose answer is known."""

from pathlib import Path

import kornia
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from fmtorch import presets
from fmtorch.features import ALIKED, DISK
from tests.features.scenes import same, texture

SIZE = (90, 131)  # no multiple of 16


def untrained(name: str) -> DISK | ALIKED:
    torch.manual_seed(0)
    if name == "disk":
        return DISK(max_features=50, score_threshold=-100.0, device="cpu", network=kornia.feature.DISK())
    return ALIKED(max_features=50, device="cpu", network=kornia.feature.ALIKED(detection_threshold=0.0))


both = pytest.mark.parametrize("name", ["disk", "aliked"])


@both
@pytest.mark.parametrize("colour", [False, True])
def test_shapes_and_ranges(name: str, colour: bool) -> None:
    image = texture(0, *SIZE)
    found = untrained(name)(np.stack([image, image[::-1], image], -1) if colour else image)
    assert 10 < len(found) <= 50
    assert found.image_size.tolist() == list(SIZE)
    assert found.descriptors.shape == (len(found), 128)
    torch.testing.assert_close(found.descriptors.norm(dim=1), torch.ones(len(found)))
    assert found.scores.shape == (len(found),)
    assert (found.keypoints >= 0).all()
    assert (found.keypoints <= torch.tensor([SIZE[1] - 1.0, SIZE[0] - 1.0])).all()
    assert torch.equal(found.lafs[..., :2], torch.eye(2).expand(len(found), 2, 2))
    for value in (found.lafs, found.scores, found.descriptors):
        value.add_(0)  # an inference tensor could not be changed, nor trained on
        assert not value.requires_grad


@both
def test_grey_is_the_same_as_equal_channels(name: str) -> None:
    image, extractor = texture(1, *SIZE), untrained(name)
    assert same(extractor(image), extractor(np.stack([image] * 3, -1)))


class Probe(nn.Module):
    """In place of DISK's network: the heatmap is the red channel, the descriptors are constant."""

    def forward(self, images: Tensor) -> Tensor:
        constant = torch.ones_like(images[:, :1]).expand(-1, 128, -1, -1)
        return torch.cat([constant, images[:, :1]], 1)


DOTS = {(37, 21): 200, (10, 60): 255, (100, 70): 120}  # (x, y): brightness


def dots() -> np.ndarray:
    image = np.zeros((*SIZE, 3), np.uint8)
    for (x, y), value in DOTS.items():
        image[y, x, 0] = value
    return image


def test_disk_keypoints_count_from_the_centre_of_the_first_pixel() -> None:
    found = DISK(network=kornia.feature.DISK(unet=Probe()), device="cpu")(dots())
    assert {
        (int(x), int(y)): round(255 * s)
        for (x, y), s in zip(found.keypoints.tolist(), found.scores.tolist(), strict=True)
    } == DOTS
    few = DISK(network=kornia.feature.DISK(unet=Probe()), device="cpu", max_features=2)(dots())
    assert sorted(round(255 * s) for s in few.scores.tolist()) == [200, 255]


def test_aliked_keypoints_count_from_the_centre_of_the_first_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    network = kornia.feature.ALIKED(detection_threshold=0.2)
    dense = lambda image: (torch.ones_like(image[:, :1]).expand(-1, 128, -1, -1), image[:, :1])  # noqa: E731
    monkeypatch.setattr(network, "extract_dense_map", dense)
    found = ALIKED(network=network, device="cpu")(dots())
    centres = found.keypoints.round().int().tolist()
    assert {tuple(centre) for centre in centres} == set(DOTS)
    # A dot is symmetric, so the refinement moves nothing; 1e-4 px is float32 on coordinates that went to [-1, 1].
    assert (found.keypoints - found.keypoints.round()).abs().max() < 1e-4
    few = ALIKED(network=network, device="cpu", max_features=2)(dots())
    assert len(few) == 2
    assert few.scores.min() > 0.7


def test_nothing_found() -> None:
    found = DISK(network=kornia.feature.DISK(unet=Probe()), device="cpu")(np.zeros(SIZE, np.uint8))
    assert found.lafs.shape == (0, 2, 3)
    assert found.descriptors.shape == (0, 128)


@both
@pytest.mark.parametrize("shape", [(31, 200), (0, 0), (1, 500, 3), (64, 64, 4)])
def test_images_that_cannot_be(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="at least 32 x 32"):
        untrained(name)(np.zeros(shape, np.uint8))


@both
def test_weights_that_cannot_be_fetched(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch_home = tmp_path / "hub"
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(torch_home))
    cls = {"disk": kornia.feature.DISK, "aliked": kornia.feature.ALIKED}[name]

    def offline(*_: object, **__: object) -> None:
        try:
            raise OSError("Name or service not known")
        except OSError as error:
            raise RuntimeError("Failed to load weights from all 2 source(s).") from error

    monkeypatch.setattr(cls, "from_pretrained", offline)
    with pytest.raises(ConnectionError) as told:
        presets.build("features", name)
    file, publisher = {
        "disk": ("depth-save.pth", "github.com/cvlab-epfl/disk"),
        "aliked": ("aliked-n16.pth", "github.com/Shiaoming/ALIKED"),
    }[name]
    for word in ("Name or service not known", publisher, f"copy its {file} to {torch_home / 'checkpoints' / file}"):
        assert word in str(told.value)
