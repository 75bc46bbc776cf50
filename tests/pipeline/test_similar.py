from pathlib import Path

import numpy as np
import pytest
import torch

from fmtorch.core import Features
from fmtorch.data import read_image
from fmtorch.features.vlad import image_vector
from fmtorch.pipeline import Described, describe, load_pipeline, similar_pairs, vectors_of
from fmtorch.pipeline import folder as similar
from tests.conftest import shared_path


def paths(n: int) -> list[Path]:
    return [Path(f"{i}.jpg") for i in range(n)]


@pytest.mark.parametrize("rows", [1, 3, 1024])
@pytest.mark.parametrize("count", [1, 2, 50])
def test_each_image_with_its_most_similar_ones(count: int, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(similar, "ROWS", rows)
    generator = torch.Generator().manual_seed(0)
    vectors = torch.nn.functional.normalize(torch.randn(9, 5, generator=generator).double(), dim=1)
    vectors[4] = 0  # an image that could not be read
    expected = set()
    for i in range(9):
        others = [j for j in range(9) if j not in (i, 4) and i != 4]
        others.sort(key=lambda j: (-float(np.dot(vectors[i].numpy(), vectors[j].numpy())), j))
        expected |= {(min(i, j), max(i, j)) for j in others[:count]}
    images = paths(9)
    assert similar_pairs(images, vectors, count) == [(images[i], images[j]) for i, j in sorted(expected)]


def test_equally_similar_images_come_by_number() -> None:
    assert similar_pairs(paths(4), torch.ones(4, 1), 1) == [(Path("0.jpg"), Path(f"{i}.jpg")) for i in (1, 2, 3)]


def test_an_image_that_cannot_be_read_has_no_vector() -> None:
    features = Features(torch.zeros(2, 2, 3), torch.zeros(2), torch.ones(2, 7), torch.tensor([4, 4]))
    described = Described(features, torch.ones(2), (4, 4), 0.0)
    vectors = vectors_of([None, described], lambda descriptors: descriptors[0])
    assert vectors.tolist() == [[0.0] * 7, [1.0] * 7]
    assert vectors_of([None], lambda descriptors: descriptors[0]).shape == (1, 1)


def test_scenes_are_told_apart() -> None:
    """Four images of each of three real scenes: none is most like an image of another scene."""
    folders = [shared_path(f"data/{name}/Images") for name in ("Strecha/fountain-P11", "KITTI/00", "TUM/fr1_rpy")]
    images = [path for folder in folders for path in sorted(folder.iterdir())[:4]]
    sift = load_pipeline("sift_ratio", overrides=["features.max_features=1500"])
    described = [describe(sift, read_image(image), 800) for image in images]
    vectors = vectors_of(described, lambda descriptors: image_vector(descriptors, "sift"))
    pairs = similar_pairs(images, vectors, 1)
    assert len(pairs) >= 6
    assert all(a.parent == b.parent for a, b in pairs)
