"""Photographs as planes: the views show what their cameras see, and matches of them are judged by that."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from fmtorch.data import DepthDataset, ImageError, ImagePair
from fmtorch.scenes import Camera, skimage_file
from fmtorch.training import MatchedPairs
from fmtorch.training.options import PlaneViews
from fmtorch.training.planes import Photograph, PlanePairs, plane_homography, random_camera
from tests.training.conftest import SIFT

SIZE = (300, 400)


def cameras(count: int, limits: PlaneViews | None = None) -> list[Camera]:
    return [random_camera(np.random.default_rng(seed), SIZE, limits or PlaneViews()) for seed in range(count)]


def on_plane(x: np.ndarray) -> np.ndarray:
    """Points of the photograph in the world: its longest side is 1, its middle the origin."""
    h, w = SIZE
    return np.column_stack([(x - np.array([(w - 1) / 2, (h - 1) / 2])) / max(h, w), np.zeros(len(x))])


@pytest.fixture(scope="module")
def photographs() -> list[Photograph]:
    return [Photograph(skimage_file(name), "scikit-image") for name in ("chelsea.png", "rocket.jpg")]


@pytest.fixture(scope="module")
def planes(photographs: list[Photograph], tmp_path_factory: pytest.TempPathFactory) -> PlanePairs:
    return PlanePairs(photographs, PlaneViews(views=3), root=tmp_path_factory.mktemp("planes"))


def test_the_homography_is_the_cameras_projection() -> None:
    x = np.random.default_rng(0).uniform(0, 299, (50, 2))
    for camera in cameras(20):
        there, depth = camera.project(on_plane(x))
        by_homography = cv2.perspectiveTransform(x[None], plane_homography(camera, SIZE))[0]
        assert np.allclose(there, by_homography, atol=1e-8)
        assert (depth > 0).all()


def test_matches_are_judged_by_the_homography(planes: PlanePairs, tmp_path: Path) -> None:
    """Labels by depth are those of the map between the views, and SIFT finds enough right matches."""
    assert isinstance(planes, DepthDataset)
    assert len(planes) == 2 * 3
    matched = MatchedPairs(planes, **SIFT, root=tmp_path, workers=1)
    by_key = {pair.key: pair for pair in planes}
    right = 0
    for i, about in enumerate(matched.pairs):
        pair, stored = by_key[about["key"]], matched.stored(i)
        H = between_views(planes, pair)
        x0, x1 = (x[0].double().numpy() for x in (stored.correspondences.x0, stored.correspondences.x1))
        forward = np.linalg.norm(cv2.perspectiveTransform(x0[None], H)[0] - x1, axis=1)
        backward = np.linalg.norm(cv2.perspectiveTransform(x1[None], np.linalg.inv(H))[0] - x0, axis=1)
        label, worst = stored.label[0].numpy(), np.maximum(forward, backward)
        clear = (np.abs(worst - 3) > 1.5) & (np.abs(worst - 6) > 1.5)  # the depths a pixel aside count, too
        assert (label == np.select([worst <= 3, worst > 6], [1, 0], -1))[clear].all()
        right += int((label == 1).sum())
        assert not stored.F.any()
    assert right > 100


def between_views(planes: PlanePairs, pair: ImagePair) -> np.ndarray:
    """The homography from the first view to the second, through four of the first one's points in space."""
    x = np.array([[50.0, 50.0], [200.0, 50.0], [200.0, 200.0], [50.0, 200.0]])
    X = planes.depth(pair.image0, x)[:, None] * np.column_stack([x, np.ones(4)]) @ np.linalg.inv(pair.K0).T
    there = (X @ pair.R.T + pair.t) @ pair.K1.T
    return cv2.getPerspectiveTransform(x.astype(np.float32), (there[:, :2] / there[:, 2:]).astype(np.float32))


def test_views_are_drawn_once_and_depend_on_what_defines_them(photographs: list[Photograph], tmp_path: Path) -> None:
    def views(root: Path) -> dict[str, bytes]:
        return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*.jpg")}

    first = PlanePairs(photographs, PlaneViews(views=2), root=tmp_path / "a", workers=2)
    alone = PlanePairs(photographs[1:], PlaneViews(views=2), root=tmp_path / "b")
    assert views(tmp_path / "b").items() < views(tmp_path / "a").items()
    assert first.digest != alone.digest
    changed = {path: path.stat().st_mtime_ns for path in (tmp_path / "a").rglob("*.jpg")}
    again = PlanePairs(photographs, PlaneViews(views=2), root=tmp_path / "a")
    assert again.digest == first.digest
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "a").rglob("*.jpg")} == changed
    other = PlanePairs(photographs, PlaneViews(views=2), seed=1, root=tmp_path / "a")
    assert other.digest != first.digest


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no photographs"):
        PlanePairs([], root=tmp_path)
    (tmp_path / "notes.jpg").write_text("not an image")
    with pytest.raises(ImageError, match=r"notes\.jpg"):
        PlanePairs([Photograph(tmp_path / "notes.jpg", "x")], root=tmp_path)
    with pytest.raises(ValueError, match=r"planes\.views=1; a pair needs 2"):
        PlaneViews(views=1)
    with pytest.raises(ValueError, match=r"planes\.part=\[1\.0, 0\.5\]"):
        PlaneViews(part=(1.0, 0.5))
