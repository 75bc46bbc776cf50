import cv2
import numpy as np
import pytest
import torch

from fmtorch.features import ASIFT, SIFT, simulate_view, simulated_views
from tests.features.scenes import same, texture


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
