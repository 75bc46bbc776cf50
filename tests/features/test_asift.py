from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.core.types import Features
from fmtorch.features import ASIFT, SIFT, simulate_view, simulated_views
from fmtorch.matching import NearestNeighborMatcher


def texture(seed: int, h: int = 160, w: int = 200) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(h, w))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.clip(128 + 90 * smooth / smooth.std() / 2, 0, 255).astype(np.uint8)


def same(a: Features, b: Features) -> bool:
    return torch.equal(a.lafs, b.lafs) and torch.equal(a.scores, b.scores) and torch.equal(a.descriptors, b.descriptors)


def test_views_are_the_published_ones() -> None:
    # Morel and Yu: tilts sqrt(2)^k, longitudes 72 / t apart below 180 degrees.
    views = simulated_views(6)
    tilts = [t for t, _ in views]
    counts = [tilts.count(t) for t in sorted(set(tilts))]
    assert counts == [1, 4, 5, 8, 10, 15]
    assert views[0] == (1.0, 0.0)
    assert max(angle for _, angle in views) < 180
    with pytest.raises(ValueError, match="at least one"):
        simulated_views(0)


@pytest.mark.parametrize(("tilt", "angle"), [(2**0.5, 0.0), (2.0, 36.0), (4.0, 126.0)])
def test_a_view_shows_the_image_where_its_map_says(tilt: float, angle: float) -> None:
    # A slow wave loses nothing by blur and interpolation, so the view must show it at the mapped places.
    y, x = np.mgrid[0:120, 0:160]
    wave = 128 + 60 * np.sin(x / 15) + 60 * np.cos(y / 18)
    view, to_view = simulate_view(wave.round().astype(np.uint8), tilt, angle)
    points = np.random.default_rng(0).uniform((30, 30), (129, 89), (500, 2))
    u, v = (to_view[:, :2] @ points.T + to_view[:, 2:]).astype(np.float32)
    found = cv2.remap(view.astype(np.float32), u[:, None], v[:, None], cv2.INTER_LINEAR)[:, 0]
    expected = 128 + 60 * np.sin(points[:, 0] / 15) + 60 * np.cos(points[:, 1] / 18)
    # Roundings to 8 bits, 3 * 0.5; interpolation and the blur of sigma 0.8 sqrt(t^2 - 1) <= 3.1 px lose less than
    # 60 (1 - exp(-3.1^2 / (2 * 15^2))) = 1.3 of each amplitude; linear interpolation over t <= 4 px 60 (4 / 15)^2 / 8.
    assert np.abs(found - expected).max() < 1.5 + 2.6 + 0.6 * 2
    corners = to_view[:, :2] @ np.array([[0, 159, 0, 159], [0, 0, 119, 119]]) + to_view[:, 2:]
    assert corners.min() > -1e-9
    assert (corners.max(1) <= np.array(view.shape[::-1]) - 1 + 1).all()


def test_one_tilt_is_sift() -> None:
    image = texture(0)
    assert same(ASIFT(tilts=1, max_features=8000)(image), SIFT()(image))


def test_frames_carry_the_view() -> None:
    image = texture(1)
    found = ASIFT(tilts=3)(image)
    assert len(found) > 2 * len(SIFT()(image))
    singular = torch.linalg.svdvals(found.lafs[..., :2].double())
    elongation = singular[:, 0] / singular[:, 1]
    nearest = torch.stack([(elongation - t).abs() for t in (1, 2**0.5, 2)]).amin(0)
    assert nearest.max() < 1e-3  # float32 entries
    for t in (2**0.5, 2):  # what the view reduced along its x was longer in the image
        assert ((elongation - t).abs() < 1e-3).sum() > 20
    centres = found.keypoints
    assert (centres >= 0).all()
    assert (centres <= torch.tensor([199.0, 159.0])).all()


def test_finds_matches_under_tilt_where_sift_finds_few() -> None:
    image = cv2.resize(texture(2, 120, 160), (480, 360), interpolation=cv2.INTER_CUBIC)
    squeeze, to_squeezed = simulate_view(image, 4.0, 30.0)
    right = {}
    for extractor in (SIFT(), ASIFT(tilts=5)):
        c = NearestNeighborMatcher()(extractor(image), extractor(squeeze))
        matrix = torch.from_numpy(to_squeezed).float()
        error = (c.x0[0] @ matrix[:, :2].T + matrix[:, 2] - c.x1[0]).norm(dim=1)
        hit = error < 2
        right[type(extractor).__name__] = int(hit.sum())
        if isinstance(
            extractor, ASIFT
        ):  # the frames of right matches agree with the map, as far as 72 / t and sqrt(2) go
            S = c.lafs1[0, hit, :, :2] @ torch.linalg.inv(c.lafs0[0, hit, :, :2])
            gap = torch.linalg.matrix_norm(S - matrix[:, :2]) / torch.linalg.matrix_norm(matrix[:, :2])
            assert gap.median() < 0.35
    assert right["ASIFT"] > 5 * max(right["SIFT"], 10)


def test_at_most_max_features_the_strongest() -> None:
    everything, few = ASIFT(tilts=2)(texture(3)), ASIFT(tilts=2, max_features=40)(texture(3))
    assert len(few) == 40
    # The cap holds in each view too, which cannot drop any of the strongest.
    assert torch.equal(few.scores.sort().values, everything.scores.sort().values[-40:])


@pytest.mark.parametrize("shape", [(1, 1), (1, 200), (200, 1), (40, 60, 3)])
def test_no_keypoints_is_no_exception(shape: tuple[int, ...]) -> None:
    found = ASIFT()(np.full(shape, 77, np.uint8))
    assert len(found) == 0
    assert found.descriptors.shape == (0, 128)
    assert found.image_size.tolist() == list(shape[:2])


def test_one_instance_serves_several_threads() -> None:
    asift, images = presets.build("features", "asift", tilts=2), [texture(i) for i in range(4)]
    alone = [asift(image) for image in images]
    with ThreadPoolExecutor(4) as pool:
        assert all(map(same, alone, pool.map(asift, images)))


def test_resembles_opencvs_affine_feature() -> None:
    # The same sampling, apart from interpolation, borders and the mask: most of its keypoints are ours.
    image = texture(6)
    keypoints, _ = cv2.AffineFeature.create(cv2.SIFT.create(enable_precise_upscale=True), 2, 1).detectAndCompute(
        image, None
    )
    theirs = torch.tensor([k.pt for k in keypoints])
    ours = ASIFT(tilts=3)(image).keypoints
    inner = ((theirs > 30) & (theirs < torch.tensor([170.0, 130.0]))).all(1)
    assert (torch.cdist(theirs[inner], ours).amin(1) < 1.5).float().mean() > 0.8
