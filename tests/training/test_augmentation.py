"""Labelled matches: labels by lines, depth and planes; augmentation."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from fmtorch import training
from fmtorch.core import Correspondences
from fmtorch.data import DepthDataset, ImageError, ImagePair, ImageSource
from fmtorch.geometry import symmetric_max
from fmtorch.scenes import RenderedPairs, calibration, fundamental, look_at, relative_pose, skimage_file
from fmtorch.training import Augmentation, LabelledMatches, PlanePairs, PlaneViews, crop, keep_ratio, rotate, swap
from fmtorch.training.labelled import EDGE_PX, by_line, by_transfer, depths, label, line_distance, transfer_error
from tests.helpers import same
from tests.reference import labels as reference
from tests.training.conftest import SIFT, exact

CHANGES: dict[str, Callable[[LabelledMatches], LabelledMatches]] = {
    "swap": swap,
    "quarter turn": lambda m: rotate(m, 0, 90),
    "three quarters": lambda m: rotate(m, 1, -90),
    "turn": lambda m: rotate(m, 0, 33.3),
    "crop": lambda m: crop(m, 0, (100, 37, 640, 400)),
    "ratio": lambda m: keep_ratio(m, 0.8),
    "all": lambda m: swap(rotate(crop(rotate(m, 0, 50), 0, (80, 80, 600, 500)), 1, 90)),
}
ALWAYS = Augmentation(swap=1, quarter_turn=0.5, turn=0.5, angle=180, crop=1, thin=1, noise=(1, 2), matches=(50, 60))
ONLY = Augmentation.none()


def expect_truth(m: LabelledMatches) -> None:
    """F, calibrations, frames and labels fit each other."""
    c = m.correspondences
    true = (m.label != 0) & c.mask
    # Coordinates below 1000 px in float64: distances of some ulps times the conditioning of the lines.
    assert symmetric_max(m.F, c.x0, c.x1)[true].max() < 1e-8
    torch.testing.assert_close(torch.linalg.matrix_norm(m.F), torch.ones(len(m)).double())
    singular = torch.linalg.svdvals(c.K1.mT @ m.F @ c.K0)
    torch.testing.assert_close(singular[:, 0], singular[:, 1], rtol=1e-9, atol=0)
    assert (singular[:, 2] < 1e-9 * singular[:, 0]).all()
    for x, lafs, K in ((c.x0, c.lafs0, c.K0), (c.x1, c.lafs1, c.K1)):
        assert torch.equal(lafs[..., 2], x)
        assert (K.tril(-1) == 0).all()
        assert (K.diagonal(dim1=-2, dim2=-1) > 0).all()
        torch.testing.assert_close(K[:, 2, 2], torch.ones(len(m)).double())


@pytest.mark.parametrize("name", CHANGES)
def test_the_truth_stays_true_after_each_change(name: str) -> None:
    before = exact(pairs=2)
    after = CHANGES[name](before)
    expect_truth(after)
    c, old = after.correspondences, before.correspondences
    assert ((after.label != 0) & c.mask).sum() > 20
    assert torch.equal(after.label[c.mask], before.label[c.mask])
    assert torch.equal(c.ratio, old.ratio)
    assert torch.equal(c.keys, old.keys)
    if name not in ("swap", "all"):  # points lie in their images
        for x, size, x_old, size_old in ((c.x0, c.size0, old.x0, old.size0), (c.x1, c.size1, old.x1, old.size1)):
            limit, old_limit = size.flip(-1)[:, None] - 0.5, size_old.flip(-1)[:, None] - 0.5
            was_inside = ((x_old >= -0.5) & (x_old < old_limit)).all(-1) & c.mask
            assert ((x >= -0.5) & (x <= limit)).all(-1)[was_inside].all()


@settings(deadline=None, max_examples=40)
@given(degrees=st.floats(-720, 720), image=st.integers(0, 1))
def test_any_turn(degrees: float, image: int) -> None:
    before = exact(3, n=30)
    after = rotate(before, image, degrees)
    c, old = after.correspondences, before.correspondences
    assert symmetric_max(after.F, c.x0, c.x1)[after.label != 0].max() < 1e-8
    x, lafs, size, x_old, lafs_old, size_old = (
        (c.x1, c.lafs1, c.size1, old.x1, old.lafs1, old.size1) if image else
        (c.x0, c.lafs0, c.size0, old.x0, old.lafs0, old.size0)
    )  # fmt: skip
    # A rigid motion that keeps the orientation: distances between points, and determinants and lengths of frames.
    torch.testing.assert_close(torch.cdist(x, x), torch.cdist(x_old, x_old), atol=1e-4, rtol=1e-7)
    torch.testing.assert_close(torch.linalg.det(lafs[..., :2]), torch.linalg.det(lafs_old[..., :2]))
    assert (size >= size_old.min()).all()
    assert torch.hypot(*size[0].double()) <= 2**0.5 * torch.hypot(*size_old[0].double()) + 2


def test_a_quarter_turn_is_exact_and_four_of_them_are_none() -> None:
    before = exact()
    c = before.correspondences
    once = rotate(before, 0, 90).correspondences
    h = c.size0[0, 0]
    assert once.size0.tolist() == [c.size0[0].flip(0).tolist()]
    assert torch.equal(once.x0, torch.stack([h - 1 - c.x0[..., 1], c.x0[..., 0]], -1))  # clockwise as one looks at it
    again = before
    for _ in range(4):
        again = rotate(again, 0, 90)
    torch.testing.assert_close(again.correspondences.x0, c.x0, rtol=0, atol=1e-12)
    torch.testing.assert_close(again.correspondences.K0, c.K0, rtol=1e-14, atol=1e-12)
    torch.testing.assert_close(again.F, before.F, rtol=0, atol=1e-14)
    assert torch.equal(again.correspondences.size0, c.size0)
    with pytest.raises(ValueError, match="size0"):
        rotate(before.replace(correspondences=c.replace(size0=None)), 0, 90)


def test_a_crop_masks_what_is_outside_and_moves_the_principal_point() -> None:
    before = exact()
    c = before.correspondences
    after = crop(before, 0, (100, 50, 400, 250)).correspondences
    inside = ((c.x0 >= torch.tensor([99.5, 49.5])) & (c.x0 < torch.tensor([399.5, 249.5]))).all(-1)
    assert torch.equal(after.mask, inside)
    assert 0 < inside.sum() < inside.numel()
    assert after.size0.tolist() == [[200, 300]]
    torch.testing.assert_close(after.K0[:, :2, 2], c.K0[:, :2, 2] - torch.tensor([100.0, 50.0]))
    assert torch.equal(after.x1, c.x1)
    with pytest.raises(ValueError, match="empty"):
        crop(before, 0, (10, 10, 10, 20))


def test_ratio_noise_and_two_swaps() -> None:
    m = exact()
    c = m.correspondences
    assert torch.equal(keep_ratio(m, 0.6).correspondences.mask, c.ratio < 0.6)
    at_one = m.replace(correspondences=c.replace(ratio=torch.ones_like(c.ratio)))
    assert keep_ratio(at_one, 1.0).correspondences.mask.all()
    with pytest.raises(ValueError, match="ratio"):
        keep_ratio(m.replace(correspondences=c.replace(ratio=None)), 0.8)
    step0, step1 = torch.full_like(c.x0, 0.5), torch.full_like(c.x1, -2.0)
    moved = training.move(m, step0, step1).correspondences
    torch.testing.assert_close(moved.x0 - c.x0, step0)
    torch.testing.assert_close(moved.lafs1[..., 2] - c.lafs1[..., 2], step1)
    assert torch.equal(moved.lafs1[..., :2], c.lafs1[..., :2])
    assert same(swap(swap(m)), m)


@pytest.mark.parametrize("epoch", range(4))
def test_the_truth_stays_true_after_any_draw(epoch: int) -> None:
    before = exact(n=400)
    augmentation = Augmentation(noise=None, matches=None, turn=0.4, quarter_turn=0.4, crop=0.7)
    after = augmentation(before, seed=0, epoch=epoch)
    expect_truth(after)
    assert after.correspondences.mask.all()
    # Every match is one of before, with its label: the ratio says which.
    old = {float(q): int(v) for q, v in zip(before.correspondences.ratio[0], before.label[0], strict=True)}
    assert [old[float(q)] for q in after.correspondences.ratio[0]] == after.label[0].tolist()


def test_the_same_draw_gives_the_same_matches_and_another_one_others() -> None:
    m = exact()
    augmented = ALWAYS(m, seed=3, epoch=5)
    assert same(augmented, ALWAYS(exact(), seed=3, epoch=5))
    assert not same(augmented, ALWAYS(m, seed=3, epoch=6))
    assert not same(augmented, ALWAYS(m, seed=4, epoch=5))
    other = m.replace(correspondences=m.correspondences.replace(key=m.correspondences.keys + 1))
    assert not same(augmented, ALWAYS(other, seed=3, epoch=5))


def test_ranges_are_kept() -> None:
    m = exact(n=600)
    for epoch in range(10):
        subset = dataclasses.replace(ONLY, matches=(50, 300))(m, seed=0, epoch=epoch)
        assert 50 <= subset.label.shape[1] <= 300
        ratio = dataclasses.replace(ONLY, ratio=(0.8, 0.9))(m, seed=0, epoch=epoch).correspondences.ratio
        assert 0.75 < ratio.max() < 0.9
        assert ratio.shape[1] >= (m.correspondences.ratio < 0.8).sum()
        thinned = dataclasses.replace(ONLY, thin=1, inlier_share=(0.3, 0.4))(m, seed=0, epoch=epoch)
        assert 0.29 < float((thinned.label == 1).sum() / (thinned.label >= 0).sum()) < 0.41
        noisy = dataclasses.replace(ONLY, noise=(0.5, 0.5))(m, seed=0, epoch=epoch).correspondences
        still = ONLY(m, seed=0, epoch=epoch).correspondences
        steps = torch.cat([noisy.x0 - still.x0, noisy.x1 - still.x1]).flatten()  # 2400 normal numbers
        assert float(steps.std()) == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(2 * len(steps)))
        assert abs(float(steps.mean())) < 4 * 0.5 / np.sqrt(len(steps))
    assert ONLY(m, seed=0, count=70).label.shape[1] == 70
    assert ONLY(m, seed=0, count=7000).label.shape[1] == 600


SIZE = (240, 320)
WALL = 4.0  # metres in front of the first camera
SKY = 200  # columns from which on nothing is there


@dataclasses.dataclass
class Wall:
    """A wall with the sky beside it, seen from two places; image 0 is the first camera's."""

    name: str = "wall"
    digest: str = "0"

    def __post_init__(self) -> None:
        K = calibration(300.0, SIZE)
        self.cameras = [look_at(K, SIZE, (x, 0.0, 0.0), (x + turn, 1.0, 0.0)) for x, turn in ((0.0, 0.0), (0.4, -0.1))]
        R, t = relative_pose(*self.cameras)
        images = [ImageSource(f"wall/{i}", Path(f"{i}.png")) for i in (0, 1)]
        F = fundamental(*self.cameras)
        self.pair = ImagePair("wall/0-1", "wall", "wall", *images, F, K, K, R, t)

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> ImagePair:
        return self.pair

    def __iter__(self):  # type: ignore[no-untyped-def]
        return iter([self.pair])

    def depth(self, image: ImageSource, points: np.ndarray) -> np.ndarray:
        camera = self.cameras[int(image.identity[-1])]
        rays = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(camera.K).T @ camera.R
        wall_depth = WALL / rays[:, 1]
        world = camera.centre + wall_depth[:, None] * rays
        return np.where(self.cameras[0].project(world)[0][:, 0] < SKY, wall_depth, np.nan)

    def partner(self, x0: np.ndarray) -> np.ndarray:
        """Where points of the wall's plane are in image 1."""
        rays = np.column_stack([x0, np.ones(len(x0))]) @ np.linalg.inv(self.cameras[0].K).T @ self.cameras[0].R
        return self.cameras[1].project(rays * (WALL / rays[:, 1:2]))[0]


def test_masked_slots_have_no_label_and_labels_move_with_their_matches() -> None:
    m = exact(pairs=3)
    kept = m.keep(m.correspondences.ratio < 0.6)
    outside = ~kept.correspondences.mask
    assert (kept.label[outside] == -1).all()
    assert not kept.inlier[outside].any()
    assert torch.equal(kept.labelled, (m.label >= 0) & kept.correspondences.mask)
    for multiple in (1, 16):
        short, expected = kept.compact(multiple), kept.correspondences.compact(multiple)
        assert short.label.shape == short.correspondences.mask.shape
        assert short.label.shape[1] % multiple == 0
        assert short.label.shape[1] < kept.correspondences.count().max() + multiple
        assert torch.equal(short.correspondences.mask, expected.mask)
        assert torch.equal(short.correspondences.x0[short.correspondences.mask], expected.x0[expected.mask])
        for a, b in zip(short, kept, strict=True):
            assert torch.equal(a.label[a.correspondences.mask], b.label[b.correspondences.mask])


def test_collate_pads_and_indexing_takes_apart() -> None:
    items = [exact(seed, n=n) for seed, n in enumerate((7, 3, 5))]
    batch = training.collate(items)
    assert (batch.label.shape, batch.correspondences.count().tolist()) == ((3, 7), [7, 3, 5])
    assert (batch.label[1, 3:] == -1).all()
    for mine, item in zip(batch, items, strict=True):
        mine = mine.compact()
        assert torch.equal(mine.label, item.label)
        assert torch.equal(mine.F, item.F)
        assert torch.equal(mine.correspondences.lafs1, item.correspondences.lafs1)
    assert len(batch[torch.tensor([True, False, True])]) == 2
    assert len(training.collate([batch, items[0]])) == 4


def test_shapes_are_checked() -> None:
    x = torch.zeros(2, 3, 2)
    c = Correspondences(x, x, torch.ones(2, 3, dtype=torch.bool))
    with pytest.raises(ValueError, match="label has shape"):
        LabelledMatches(c, torch.zeros(2, 4, dtype=torch.int8), torch.zeros(2, 3, 3).double())
    with pytest.raises((ValueError, TypeCheckError), match=r"F has shape|parameter 'F'"):
        LabelledMatches(c, torch.zeros(2, 3, dtype=torch.int8), torch.zeros(1, 3, 3).double())


def test_the_sky_is_ignored_near_its_line_and_wrong_far_from_it() -> None:
    wall = Wall()
    x0 = np.array([[250.0, 100.0], [250.0, 100.0]])
    x1 = wall.partner(x0)
    x1[1, 1] += 20
    assert label(wall, wall.pair, x0, x1).tolist() == [-1, 0]


def test_without_depth_or_cameras_the_epipolar_lines_decide() -> None:
    wall = Wall()
    x0 = np.full((4, 2), 100.0)
    x1 = wall.partner(x0)
    line = (np.column_stack([x0, np.ones(4)]) @ wall.pair.F.T)[0]
    normal = line[:2] / np.hypot(*line[:2])
    x1 = x1 + normal * np.array([0.0, 2.0, 4.0, 9.0])[:, None]
    distance = line_distance(wall.pair.F, x0, x1)
    expected = [1, 1, -1, 0]
    assert by_line(distance).tolist() == expected
    uncalibrated = dataclasses.replace(wall.pair, K0=None)
    assert label(wall, uncalibrated, x0, x1).tolist() == expected

    class NoDepth:
        name, digest = "none", "0"
        __len__, __getitem__, __iter__ = Wall.__len__, Wall.__getitem__, Wall.__iter__

    assert label(NoDepth(), wall.pair, x0, x1).tolist() == expected
    empty = np.zeros((0, 2))
    assert label(wall, wall.pair, empty, empty).shape == (0,)


def test_a_keypoint_beside_an_edge_of_depth_may_belong_to_either_side() -> None:
    class Edge(Wall):
        def depth(self, image: ImageSource, points: np.ndarray) -> np.ndarray:
            near = points[:, 0] > 100.0 if image.identity == "wall/0" else np.ones(len(points), bool)
            return np.where(near, super().depth(image, points), 3 * WALL)

    edge = Edge()
    x0 = np.array([[100.0 - 0.5 * EDGE_PX, 80.0], [100.0 - 1.5 * EDGE_PX, 80.0]])
    assert label(edge, edge.pair, x0, edge.partner(x0)).tolist() == [1, 0]


def test_a_point_that_would_be_behind_the_other_camera_is_wrong() -> None:
    K = np.eye(3)
    origin = np.zeros((1, 2))
    forward = transfer_error(origin, np.ones((1, 1)), origin, K, K, np.eye(3), np.array([0, 0, -2.0]))
    assert forward == np.inf
    assert by_transfer(forward, np.array([np.nan]), np.zeros(1)).tolist() == [0]


def test_rendered_labels_equal_the_scalar_reference(rendered: RenderedPairs) -> None:
    """Random and near-true matches of rendered pairs; depths are those of `depth_at`, which has a test of its own."""
    rng = np.random.default_rng(1)
    seen = set()
    for index in range(0, len(rendered), 3):
        pair = rendered[index]
        x0 = rng.uniform(0, [150, 110], (80, 2))
        depth0 = rendered.depth(pair.image0, x0)
        rays = np.column_stack([x0, np.ones(80)]) @ np.linalg.inv(pair.K0).T
        there = (rays * np.nan_to_num(depth0, nan=1.0)[:, None] @ pair.R.T + pair.t) @ pair.K1.T
        x1 = there[:, :2] / there[:, 2:] + rng.normal(0, 1, (80, 2)) * rng.choice([0.3, 3, 30], (80, 1))
        labels = label(rendered, pair, x0, x1)
        d0, d1 = depths(rendered, pair.image0, x0), depths(rendered, pair.image1, x1)
        for i in range(80):
            forward = reference.transfer_error(x0[i], d0[:, i], x1[i], pair.K0, pair.K1, pair.R, pair.t)
            backward = reference.transfer_error(x1[i], d1[:, i], x0[i], pair.K1, pair.K0, pair.R.T, -pair.R.T @ pair.t)
            line = reference.line_distance(pair.F, x0[i], x1[i])
            assert labels[i] == reference.label(forward, backward, line)
        seen |= set(labels.tolist())
    assert seen == {-1, 0, 1}


PLANE_SIZE = (300, 400)


@pytest.fixture(scope="module")
def photographs() -> list[training.Photograph]:
    return [training.Photograph(skimage_file(name), "scikit-image") for name in ("chelsea.png", "rocket.jpg")]


@pytest.fixture(scope="module")
def planes(photographs: list[training.Photograph], tmp_path_factory: pytest.TempPathFactory) -> PlanePairs:
    return PlanePairs(photographs, PlaneViews(views=3), root=tmp_path_factory.mktemp("planes"))


def test_the_homography_is_the_cameras_projection() -> None:
    x = np.random.default_rng(0).uniform(0, 299, (50, 2))
    for seed in range(20):
        camera = training.random_camera(np.random.default_rng(seed), PLANE_SIZE, PlaneViews())
        # Its longest side is 1, its middle the origin.
        plane = np.c_[(x - (np.array(PLANE_SIZE[::-1]) - 1) / 2) / max(PLANE_SIZE), np.zeros(len(x))]
        there, depth = camera.project(plane)
        by_homography = cv2.perspectiveTransform(x[None], training.plane_homography(camera, PLANE_SIZE))[0]
        assert np.allclose(there, by_homography, atol=1e-8)
        assert (depth > 0).all()


def test_matches_are_judged_by_the_homography(planes: PlanePairs, tmp_path: Path) -> None:
    assert isinstance(planes, DepthDataset)
    assert len(planes) == 2 * 3
    matched = training.MatchedPairs(planes, **SIFT, root=tmp_path, workers=1)
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


def test_views_are_drawn_once_and_depend_on_what_defines_them(photographs, tmp_path):
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
    turns = {"turn": 0.6, "quarter_turn": 0.6}
    for options, message in (({"swap": 2}, "swap=2"), (turns, "exclude"), ({"ratio": (1.0, 0.8)}, "ratio is")):
        with pytest.raises(ValueError, match=message):
            Augmentation(**options)
    with pytest.raises(ValueError, match="batch of 2"):
        Augmentation()(exact(pairs=2), seed=0)
    with pytest.raises(ValueError, match="no photographs"):
        PlanePairs([], root=tmp_path)
    (tmp_path / "notes.jpg").write_text("not an image")
    with pytest.raises(ImageError, match=r"notes\.jpg"):
        PlanePairs([training.Photograph(tmp_path / "notes.jpg", "x")], root=tmp_path)
    with pytest.raises(ValueError, match=r"planes\.part=\[1\.0, 0\.5\]"):
        PlaneViews(part=(1.0, 0.5))
