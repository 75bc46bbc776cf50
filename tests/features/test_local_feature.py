"""Features of parts, presets of them, large images, image vectors."""

import hashlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch import features, presets
from fmtorch.core import models_dir
from fmtorch.features import describe
from scripts.make_models import learned
from tests.features.scenes import texture
from tests.helpers import same
from tests.processes import run_command
from tests.reference import local_features as reference


def random_network(seed: int, outputs: int) -> torch.nn.Module:
    torch.manual_seed(seed)
    return torch.nn.Sequential(
        torch.nn.Conv2d(1, 8, 5, stride=3), torch.nn.Tanh(), torch.nn.Flatten(), torch.nn.Linear(800, outputs)
    ).requires_grad_(False)


@pytest.mark.parametrize("name", ["rootsift", "dspsift", "rootsiftpca"])
def test_presets_describe_the_keypoints_of_sift(name: str) -> None:
    image = texture(0)
    found = presets.build("features", name)(image)
    plain = features.SIFT()(image)
    assert torch.equal(found.lafs, plain.lafs)
    assert torch.equal(found.scores, plain.scores)
    torch.testing.assert_close(found.descriptors.norm(dim=1), torch.ones(len(found)))


def test_a_call_is_detection_and_description() -> None:
    shape, image = random_network(0, 3), texture(1)
    shaped = features.NetworkShape(lambda patches: 0.2 * torch.tanh(shape(patches)))
    parts = features.NetworkDescriptor(random_network(1, 128)), shaped, features.DominantGradient()
    extract = features.LocalFeature(features.HessianDetector(300), *parts)
    lafs, scores = extract.detect(image)
    found = extract(image)
    assert len(found) > 100
    assert torch.equal(found.lafs, lafs)
    assert torch.equal(found.scores, scores)
    assert torch.equal(found.descriptors, extract.describe(image, lafs))
    # A descriptor does not depend on its neighbours; the image is described as its grey levels.
    torch.testing.assert_close(extract.describe(image, lafs[5:6]), found.descriptors[5:6], atol=1e-5, rtol=0)
    assert same(extract(np.stack([image] * 3, -1)), found)


def test_equal_parts_define_equal_detection() -> None:
    first = features.local_feature("dog", "rootsift")
    assert first.detection == features.local_feature("dog", {"name": "dspsift", "sizes": 3}).detection
    assert first.detection != features.local_feature("dog", "rootsift", max_features=100).detection
    assert first.detection != features.local_feature("hessian", "rootsift").detection
    hessian = features.local_feature({"name": "hessian", "levels": 2}, "sift", orientation="dominant_gradient")
    assert hessian == features.local_feature({"name": "hessian", "levels": 2}, "sift", orientation="dominant_gradient")
    assert isinstance(hessian.detector, features.HessianDetector)
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
        features.local_feature(**options)  # type: ignore[arg-type]


def test_large_images_are_reduced_for_opencv() -> None:
    image = texture(7, 300, 401)
    full, reduced = features.SIFT(), features.SIFT(max_pixels=300 * 401 // 2)
    a, b = full(image), reduced(image)
    assert reduced.detect(image)[0].shape == b.lafs.shape
    gap, nearest = (b.lafs[..., 2][:, None] - a.lafs[..., 2]).norm(dim=2).min(1)
    close = gap < 1
    assert close.float().mean() > 0.5
    shift = (b.lafs[close][..., 2] - a.lafs[nearest[close]][..., 2]).median(0).values
    assert shift.abs().max() < 0.15  # half a pixel missed would show as 0.2
    assert torch.equal(features.SIFT(max_pixels=300 * 401)(image).lafs, a.lafs)


NAMES = [n for n in presets.available("features") if n not in ("aliked", "disk", "xfeat", "none")]  # in models/
every = pytest.mark.parametrize("name", NAMES)
SHAPES = [(1, 1), (1, 300), (300, 1), (20, 31), (60, 80, 3)]


def build(name: str, **options: object):
    """The preset; VLFeat's SIFT and the simulated views need a package and time."""
    if name == "sift_vlfeat":
        pytest.importorskip("pycolmap", reason="extra colmap is not installed")
    return presets.build("features", name, **{"tilts": 2} if name == "asift" else {}, **options)


@every
def test_small_and_constant_images(name: str) -> None:
    extract = build(name)
    length = extract(texture(0, 60, 80)).descriptors.shape[1]
    for shape in SHAPES:
        flat, noise = np.full(shape, 77, np.uint8), np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
        for image in (flat, noise):
            found = extract(image)
            assert found.image_size.tolist() == list(shape[:2])
            assert found.descriptors.shape == (len(found), length)
            for value in (found.lafs, found.scores, found.descriptors):
                assert bool(torch.isfinite(value).all())
            assert len(found) == 0 or image is noise


@every
def test_threads_and_colour_change_nothing_and_only_images_are_taken(name: str) -> None:
    extract, images = build(name), [texture(i, 80, 100) for i in range(3)]
    alone = [extract(image) for image in images]
    with ThreadPoolExecutor(3) as pool:
        assert all(map(same, alone, pool.map(extract, images)))
    colour = np.stack(images, -1)
    assert same(extract(colour), extract(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)))
    for wrong in (np.zeros((0, 5), np.uint8), np.zeros((5, 5, 4), np.uint8), np.zeros(5, np.uint8)):
        with pytest.raises(ValueError, match="uint8"):
            extract(wrong)


@every
def test_at_most_max_features_the_strongest(name: str) -> None:
    image = np.tile(texture(5, 60, 60), (2, 3))  # repeated texture: equal scores
    everything, few = build(name)(image), build(name, max_features=20)(image)
    assert len(few) == 20
    assert float(few.scores.min()) >= float(everything.scores.sort(descending=True).values[19])


GROWTH = """
import sys, time
import cv2, numpy as np, torch
from fmtorch import presets
from tests.processes import peak_memory

torch.set_num_threads(1)
name, options = sys.argv[1], {"max_features": 500}
extract = presets.build("features", name, **options)
noise = np.random.default_rng(0).integers(0, 256, (512, 512)).astype(np.uint8)
extract(noise)  # what is read and made on first use is not counted
image = cv2.resize(noise, (8192, 8192), interpolation=cv2.INTER_CUBIC)
before = peak_memory()
found = extract(image)
assert len(found) == 500, len(found)
assert found.image_size.tolist() == [8192, 8192]
assert bool(torch.isfinite(found.lafs).all())
x = found.lafs[:, :, 2]
assert float(x.max()) > 6000  # keypoints all over the image, in its own pixels
print(peak_memory() - before)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
@pytest.mark.parametrize(("name", "bound"), [("sift", 4.0e9), pytest.param("hesaffnet", 2.5e9, marks=pytest.mark.slow)])
def test_8k_images_within_the_stated_memory(name: str, bound: float, tmp_path: Path) -> None:
    """As docs/benchmarks/features.md states: SIFT sees at most 16 million pixels, the Hessian all 67 million."""
    result = run_command("-c", GROWTH, name, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) < bound, f"{int(result.stdout) / 1e9:.2f} GB"


def book(seed: int = 0) -> describe.Codebook:
    generator = torch.Generator().manual_seed(seed)
    basis = torch.linalg.qr(torch.randn(12, 6, generator=generator))[0]
    return describe.Codebook(torch.randn(12, generator=generator), basis, torch.randn(5, 6, generator=generator))


def sift(seed: int, n: int) -> Tensor:
    return torch.randint(0, 120, (n, 128), generator=torch.Generator().manual_seed(seed)).float()


@pytest.mark.parametrize("n", [0, 1, 3, 200])
def test_equals_the_definition(n: int) -> None:
    descriptors = torch.randn(n, 12, generator=torch.Generator().manual_seed(n))
    expected = reference.vlad(descriptors.double().numpy(), *(each.double().numpy() for each in book()))
    found = describe.vlad(descriptors, book())
    # Square roots near zero: an error of 1e-7 in a residual may be one of 3e-4 in its root.
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-3)
    np.testing.assert_allclose((found**2 * found.sign()).numpy(), expected**2 * np.sign(expected), atol=1e-6)


def test_descriptors_without_meaning_are_left_out() -> None:
    descriptors = sift(0, 40)
    bad = descriptors.clone()
    bad[3], bad[7, 2] = 0, torch.nan
    kept = [i for i in range(40) if i not in (3, 7)]
    assert torch.equal(describe.local_descriptors(bad, "sift"), describe.local_descriptors(descriptors[kept], "sift"))
    assert torch.equal(describe.image_vector(bad, "sift"), describe.image_vector(descriptors[kept], "sift"))
    assert not describe.image_vector(torch.zeros(4, 128), "sift").any()


def test_sift_of_any_scale_is_one_descriptor() -> None:
    plain, scaled = (describe.local_descriptors(values, "sift") for values in (sift(0, 9), sift(0, 9) / 512))
    torch.testing.assert_close(plain, scaled)


def test_pipelines_and_their_codebooks() -> None:
    kinds = {
        "sift_fmtorch": "sift", "dspsift_ratio": "sift", "rootsiftpca_gms": "rootsiftpca", "hardnet_gms": "hardnet",
        "hesaffnet_fmtorch": "hardnet", "hesaffnet_fast_fmtorch": "hardnet",
    }  # fmt: skip
    stages = {name: presets.pipeline_stages(name)["features"] for name in (*kinds, "l2net_ratio")}
    assert {name: describe.descriptor_kind(stages[name]) for name in kinds} == kinds
    with pytest.raises(ValueError, match="no codebook for the descriptors l2net; it must be a pipeline with SIFT"):
        describe.descriptor_kind(stages["l2net_ratio"])
    with pytest.raises(ValueError, match="no codebook for the descriptors Mine"):
        describe.descriptor_kind({"_target_": "mine.Mine"})


@pytest.mark.parametrize(("name", "kind"), [("rootsift_pca", "sift"), ("hardnet", "hardnet")])
def test_the_shipped_codebooks_are_those_of_the_card(name: str, kind: str) -> None:
    file = models_dir() / f"vlad_{name}.npz"
    card = (models_dir() / f"vlad_{name}.md").read_text()
    assert hashlib.sha256(file.read_bytes()).hexdigest() in card
    assert file.stat().st_size < 2_000_000
    shipped = describe.codebook(kind)  # type: ignore[arg-type]
    assert shipped.centers.shape == (64, 64)
    torch.testing.assert_close(shipped.basis.T @ shipped.basis, torch.eye(64), atol=1e-5, rtol=0)


def test_files_that_are_no_codebook_are_reported(tmp_path: Path) -> None:
    said = r"no such file; make it with `python scripts/make_models\.py codebooks`"
    with pytest.raises(FileNotFoundError, match=said):
        describe.load_codebook(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(ValueError, match=r"text\.npz: no file with mean, basis, centers"):
        describe.load_codebook(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", mean=np.zeros(4), basis=np.zeros((5, 2)), centers=np.zeros((3, 2)))
    with pytest.raises(ValueError, match="mean, basis and centers do not fit"):
        describe.load_codebook(tmp_path / "other.npz")


def test_k_means_finds_clusters() -> None:
    generator = torch.Generator().manual_seed(0)
    true = 10 * torch.randn(6, 8, generator=generator)
    x = true.repeat(50, 1) + 0.1 * torch.randn(300, 8, generator=generator)
    book = learned([x], 6, 8)
    distances = torch.cdist(book.centers, (true - book.mean) @ book.basis)
    assert distances.min(1).values.max() < 0.1  # 0.1 sqrt(8 / 50) = 0.04 is expected
    assert sorted(distances.argmin(1).tolist()) == list(range(6))
    assert learned([x], 6, 4).basis.shape == (8, 4)
