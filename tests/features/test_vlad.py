import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch import presets
from fmtorch.core import models_dir
from fmtorch.features.vlad import (
    Codebook,
    codebook,
    descriptor_kind,
    image_vector,
    load_codebook,
    local_descriptors,
    vlad,
)
from scripts.make_models import k_means, learned
from tests.reference import local_features as reference


def book(seed: int = 0) -> Codebook:
    generator = torch.Generator().manual_seed(seed)
    basis = torch.linalg.qr(torch.randn(12, 6, generator=generator))[0]
    return Codebook(torch.randn(12, generator=generator), basis, torch.randn(5, 6, generator=generator))


def sift(seed: int, n: int) -> Tensor:
    return torch.randint(0, 120, (n, 128), generator=torch.Generator().manual_seed(seed)).float()


@pytest.mark.parametrize("n", [0, 1, 3, 200])
def test_equals_the_definition(n: int) -> None:
    descriptors = torch.randn(n, 12, generator=torch.Generator().manual_seed(n))
    expected = reference.vlad(descriptors.double().numpy(), *(each.double().numpy() for each in book()))
    found = vlad(descriptors, book())
    # Square roots near zero: an error of 1e-7 in a residual may be one of 3e-4 in its root.
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-3)
    np.testing.assert_allclose((found**2 * found.sign()).numpy(), expected**2 * np.sign(expected), atol=1e-6)


def test_descriptors_without_meaning_are_left_out() -> None:
    descriptors = sift(0, 40)
    bad = descriptors.clone()
    bad[3], bad[7, 2] = 0, torch.nan
    kept = [i for i in range(40) if i not in (3, 7)]
    assert torch.equal(local_descriptors(bad, "sift"), local_descriptors(descriptors[kept], "sift"))
    assert torch.equal(image_vector(bad, "sift"), image_vector(descriptors[kept], "sift"))
    assert not image_vector(torch.zeros(4, 128), "sift").any()


def test_sift_of_any_scale_is_one_descriptor() -> None:
    torch.testing.assert_close(local_descriptors(sift(0, 9), "sift"), local_descriptors(sift(0, 9) / 512, "sift"))


@pytest.mark.parametrize(
    ("pipeline", "kind"),
    [
        ("sift_fmtorch", "sift"), ("dspsift_ratio", "sift"), ("rootsiftpca_gms", "rootsiftpca"),
        ("hesaffnet_fmtorch", "hardnet"), ("hesaffnet_fast_fmtorch", "hardnet"), ("hardnet_gms", "hardnet"),
    ],
)  # fmt: skip
def test_pipelines_and_their_codebooks(pipeline: str, kind: str) -> None:
    stages = presets.pipeline_stages(pipeline)
    assert descriptor_kind(stages["features"]) == kind


def test_descriptors_without_a_codebook_are_told() -> None:
    stages = presets.pipeline_stages("l2net_ratio")
    with pytest.raises(ValueError, match="no codebook for the descriptors l2net; it must be a pipeline with SIFT"):
        descriptor_kind(stages["features"])
    with pytest.raises(ValueError, match="no codebook for the descriptors Mine"):
        descriptor_kind({"_target_": "mine.Mine"})


@pytest.mark.parametrize(("name", "kind"), [("rootsift_pca", "sift"), ("hardnet", "hardnet")])
def test_the_shipped_codebooks_are_those_of_the_card(name: str, kind: str) -> None:
    file = models_dir() / f"vlad_{name}.npz"
    card = (models_dir() / f"vlad_{name}.md").read_text()
    assert hashlib.sha256(file.read_bytes()).hexdigest() in card
    assert file.stat().st_size < 2_000_000
    shipped = codebook(kind)  # type: ignore[arg-type]
    assert shipped.centers.shape == (64, 64)
    torch.testing.assert_close(shipped.basis.T @ shipped.basis, torch.eye(64), atol=1e-5, rtol=0)


def test_files_that_are_no_codebook_are_told(tmp_path: Path) -> None:
    with pytest.raises(
        FileNotFoundError, match=r"no such file; make it with `python scripts/make_models\.py codebooks`"
    ):
        load_codebook(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(ValueError, match=r"text\.npz: no file with mean, basis, centers"):
        load_codebook(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", mean=np.zeros(4), basis=np.zeros((5, 2)), centers=np.zeros((3, 2)))
    with pytest.raises(ValueError, match="mean, basis and centers do not fit"):
        load_codebook(tmp_path / "other.npz")


def test_k_means_finds_clusters() -> None:
    generator = torch.Generator().manual_seed(0)
    true = 10 * torch.randn(6, 8, generator=generator)
    x = true.repeat(50, 1) + 0.1 * torch.randn(300, 8, generator=generator)
    distances = torch.cdist(k_means(x, 6), true)
    assert distances.min(1).values.max() < 0.1  # 0.1 sqrt(8 / 50) = 0.04 is expected
    assert sorted(distances.argmin(1).tolist()) == list(range(6))
    assert learned([x], 6, 4).basis.shape == (8, 4)
