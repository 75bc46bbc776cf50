"""What every preset of features keeps to: a new file in conf/ joins by being there."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import torch

from fmtorch import presets
from tests.features.scenes import same, texture

DOWNLOADED = ("aliked", "disk")  # their weights are not in models/; see test_kornia_features.py
NAMES = [name for name in presets.available("features") if name not in (*DOWNLOADED, "none")]
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
