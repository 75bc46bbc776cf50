from pathlib import Path

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.features import (
    SIFT,
    DominantGradient,
    HessianDetector,
    LocalFeature,
    NetworkDescriptor,
    NetworkShape,
    local_feature,
)
from fmtorch.runs.feature_cache import ArrayCache, CachedFeatures
from tests.features.scenes import same, texture

WITHOUT_NETWORK = ("rootsift", "dspsift", "rootsiftpca")


def random_network(seed: int, outputs: int) -> torch.nn.Module:
    torch.manual_seed(seed)
    return torch.nn.Sequential(
        torch.nn.Conv2d(1, 8, 5, stride=3), torch.nn.Tanh(), torch.nn.Flatten(), torch.nn.Linear(800, outputs)
    ).requires_grad_(False)


def composed() -> LocalFeature:
    shape = random_network(0, 3)
    return LocalFeature(
        HessianDetector(300),
        NetworkDescriptor(random_network(1, 128)),
        NetworkShape(lambda patches: 0.2 * torch.tanh(shape(patches))),
        DominantGradient(),
    )


@pytest.mark.parametrize("name", WITHOUT_NETWORK)
def test_presets_describe_the_keypoints_of_sift(name: str) -> None:
    image = texture(0)
    found = presets.build("features", name)(image)
    plain = SIFT()(image)
    assert torch.equal(found.lafs, plain.lafs)
    assert torch.equal(found.scores, plain.scores)
    torch.testing.assert_close(found.descriptors.norm(dim=1), torch.ones(len(found)))


def test_a_call_is_detection_and_description() -> None:
    extract, image = composed(), texture(1)
    lafs, scores = extract.detect(image)
    found = extract(image)
    assert len(found) > 100
    assert torch.equal(found.lafs, lafs)
    assert torch.equal(found.scores, scores)
    assert torch.equal(found.descriptors, extract.describe(image, lafs))
    # A descriptor does not depend on its neighbours; the image is described as its grey levels.
    alone = extract.describe(image, lafs[5:6])
    torch.testing.assert_close(alone, found.descriptors[5:6], atol=1e-5, rtol=0)
    assert same(extract(np.stack([image] * 3, -1)), found)


def test_equal_parts_define_equal_detection() -> None:
    first = local_feature("dog", "rootsift")
    assert first.detection == local_feature("dog", {"name": "dspsift", "sizes": 3}).detection
    assert first.detection != local_feature("dog", "rootsift", max_features=100).detection
    assert first.detection != local_feature("hessian", "rootsift").detection
    hessian = local_feature({"name": "hessian", "levels": 2}, "sift", orientation="dominant_gradient")
    assert hessian == local_feature({"name": "hessian", "levels": 2}, "sift", orientation="dominant_gradient")
    assert isinstance(hessian.detector, HessianDetector)
    assert hessian.detector.max_features == 8000


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"detector": "harris", "descriptor": "sift"}, "detector=harris.*dog, hessian"),
        ({"detector": "dog", "descriptor": "surf"}, "descriptor=surf.*hardnet"),
        ({"detector": "dog", "descriptor": "sift", "shape": "baumberg"}, "shape=baumberg.*affnet"),
        ({"detector": "dog", "descriptor": "sift", "orientation": "up"}, "orientation=up.*dominant_gradient"),
        ({"detector": {"name": "hessian", "octaves": 3}, "descriptor": "sift"}, "hessian.*octaves"),
        ({"detector": {"threshold": 3}, "descriptor": "sift"}, "detector=None"),
        ({"detector": "dog", "descriptor": "sift", "precision": "fp16"}, "precision=fp16.*fp32"),
    ],
)
def test_unknown_parts_and_options(options: dict[str, object], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        local_feature(**options)  # type: ignore[arg-type]


def test_networks_are_read_when_first_used(tmp_path: Path) -> None:
    missing = tmp_path / "mine.onnx"
    extract = local_feature("hessian", {"name": "hardnet", "network": str(missing)}, shape=None)
    with pytest.raises(ValueError, match=r"mine\.onnx.*patch_networks.export"):
        extract(texture(4))
    with pytest.raises(ValueError, match=r"mine\.onnx.*patch_networks.export"):
        CachedFeatures(extract, ArrayCache(tmp_path))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # the older exporter takes a fraction of the time
def test_hesaffnet_runs_through_onnx(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    files = {}
    for i, (name, outputs) in enumerate({"affnet": 3, "hardnet": 128, "orinet": 2}.items()):
        files[name] = str(tmp_path / f"{name}.onnx")
        torch.onnx.export(
            random_network(i, outputs), (torch.zeros(4, 1, 32, 32),), files[name], input_names=["patches"],
            output_names=["values"], dynamo=False, dynamic_axes={"patches": {0: "n"}, "values": {0: "n"}},
        )  # fmt: skip
    extract = local_feature(
        "hessian",
        {"name": "hardnet", "network": files["hardnet"]},
        shape={"name": "affnet", "network": files["affnet"]},
        orientation={"name": "orinet", "network": files["orinet"]},
        max_features=50,
    )
    found = extract(texture(5))
    assert found.descriptors.shape == (50, 128)
    assert torch.isfinite(found.lafs).all()
    same_in_torch = LocalFeature(extract.detector, NetworkDescriptor(random_network(1, 128)))
    described = same_in_torch.describe(texture(5), found.lafs)
    kept = CachedFeatures(extract, ArrayCache(tmp_path / "cache"))
    for _ in range(2):  # computed, then found
        assert same(kept(texture(5)), found)
    assert (kept.computed, kept.found) == (1, 1)
    torch.testing.assert_close(found.descriptors, described, atol=1e-4, rtol=0)


def test_large_images_are_reduced_for_opencv() -> None:
    image = texture(7, 300, 401)
    full, reduced = SIFT(), SIFT(max_pixels=300 * 401 // 2)
    a, b = full(image), reduced(image)
    assert reduced.detect(image)[0].shape == b.lafs.shape
    gap, nearest = (b.lafs[..., 2][:, None] - a.lafs[..., 2]).norm(dim=2).min(1)
    close = gap < 1
    assert close.float().mean() > 0.5
    shift = (b.lafs[close][..., 2] - a.lafs[nearest[close]][..., 2]).median(0).values
    assert shift.abs().max() < 0.15  # half a pixel missed would show as 0.2
    assert torch.equal(SIFT(max_pixels=300 * 401)(image).lafs, a.lafs)
