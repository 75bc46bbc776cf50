"""LightGlue behind the project's conventions, with an untrained network."""

import re
import urllib.request
from pathlib import Path

import kornia
import pytest
import torch

from fmtorch import presets
from fmtorch.core import Features, onnx_network
from fmtorch.matching import LightGlue


def matcher(threshold: float = -1.0) -> LightGlue:
    """Untrained; every mutual nearest neighbour is a match at the threshold -1."""
    torch.manual_seed(0)
    network = kornia.feature.LightGlue(None, input_dim=128, filter_threshold=threshold)
    return LightGlue("disk", device="cpu", network=network)


def features(seed: int, count: int, size: tuple[int, int] = (100, 400), length: int = 128) -> Features:
    rng = torch.Generator().manual_seed(seed)
    lafs = torch.eye(2, 3).repeat(count, 1, 1)
    lafs[..., 2] = torch.rand(count, 2, generator=rng) * torch.tensor([size[1] - 1.0, size[0] - 1.0])
    descriptors = torch.nn.functional.normalize(torch.randn(count, length, generator=rng), dim=1)
    return Features(lafs, torch.ones(count), descriptors, torch.tensor(size))


def test_equals_kornias_matcher() -> None:
    glue, a, b = matcher(), features(0, 60), features(1, 50, (300, 120))
    c = glue(a, b)  # wide and tall: kornia refuses keypoints outside of an image whose sizes are swapped
    reference = kornia.feature.LightGlueMatcher.__new__(kornia.feature.LightGlueMatcher)
    torch.nn.Module.__init__(reference)
    reference.feature_name, reference.matcher = "disk", glue.network
    with torch.no_grad():
        scores, index = reference(a.descriptors, b.descriptors, a.lafs[None], b.lafs[None], (100, 400), (300, 120))
    assert len(index) > 5
    assert torch.equal(c.x0[0], a.keypoints[index[:, 0]])
    assert torch.equal(c.x1[0], b.keypoints[index[:, 1]])
    assert torch.equal(c.prior[0], scores[:, 0])
    assert ((c.prior >= 0) & (c.prior <= 1)).all()
    assert torch.equal(c.score, c.prior)
    assert c.mask.all()
    assert c.size0.tolist() == [[100, 400]]


def test_frames_without_meaning_are_not_handed_on() -> None:
    c = matcher()(features(0, 60), features(1, 50))
    assert c.lafs0 is None
    assert c.lafs1 is None
    assert presets.build("pruner", "frame_consistency")(c) is c


@pytest.mark.parametrize("counts", [(0, 5), (1, 5), (5, 1), (0, 0)])
def test_too_few_features_give_no_match(counts: tuple[int, int]) -> None:
    c = matcher()(features(0, counts[0]), features(1, counts[1]))
    assert c.x0.shape == (1, 0, 2)


def test_descriptors_of_another_length_and_unknown_features_are_reported() -> None:
    with pytest.raises(ValueError, match=r"descriptors are \(5, 64\).*\(N, 128\)"):
        matcher()(features(0, 5), features(1, 5, length=64))
    with pytest.raises(ValueError, match="aliked, disk, xfeat"):
        presets.build("matcher", "lightglue", features="sift")


def test_weights_that_cannot_be_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))

    def offline(*_: object, **__: object) -> None:
        raise RuntimeError("Name or service not known")

    monkeypatch.setattr(kornia.feature, "LightGlue", type("L", (kornia.feature.LightGlue,), {"__init__": offline}))
    said = r"LightGlue \(disk\).*Name or service.*github\.com/cvg/LightGlue"
    with pytest.raises(ConnectionError, match=said) as error:
        presets.build("matcher", "lightglue", features="disk")
    place = re.search(r"copy its disk_lightglue\.pth to (\S+)", str(error.value))
    monkeypatch.undo()
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(urllib.request, "urlopen", offline)
    Path(place[1]).parent.mkdir()
    network = kornia.feature.LightGlue(None, input_dim=128)
    torch.save(network.state_dict(), place[1])
    monkeypatch.delitem(onnx_network.PUBLISHED, "disk_lightglue.pth")
    loaded = LightGlue("disk", device="cpu").network
    assert torch.equal(next(loaded.parameters()), next(network.parameters()))
