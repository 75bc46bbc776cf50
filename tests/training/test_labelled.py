"""`LabelledMatches`: shapes, masks, collation; labels against a scalar reference, and known answers on a plane."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from fmtorch.core import Correspondences
from fmtorch.data import ImagePair, ImageSource
from fmtorch.scenes import RenderedPairs, calibration, fundamental, look_at, relative_pose
from fmtorch.training import LabelledMatches, collate
from fmtorch.training.labelled import EDGE_PX, by_line, by_transfer, depths, label, line_distance, transfer_error
from tests.reference import labels as reference
from tests.training.conftest import exact

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
    batch = collate(items)
    assert batch.label.shape == (3, 7)
    assert batch.correspondences.count().tolist() == [7, 3, 5]
    assert (batch.label[1, 3:] == -1).all()
    for mine, item in zip(batch, items, strict=True):
        mine = mine.compact()
        assert torch.equal(mine.label, item.label)
        assert torch.equal(mine.F, item.F)
        assert torch.equal(mine.correspondences.lafs1, item.correspondences.lafs1)
    assert len(batch[torch.tensor([True, False, True])]) == 2
    assert len(collate([batch, items[0]])) == 4
    with pytest.raises(ValueError, match="at least one"):
        collate([])


def test_shapes_are_checked() -> None:
    x = torch.zeros(2, 3, 2)
    c = Correspondences(x, x, torch.ones(2, 3, dtype=torch.bool))
    with pytest.raises(ValueError, match="label has shape"):
        LabelledMatches(c, torch.zeros(2, 4, dtype=torch.int8), torch.zeros(2, 3, 3).double())
    with pytest.raises((ValueError, TypeCheckError), match=r"F has shape|parameter 'F'"):
        LabelledMatches(c, torch.zeros(2, 3, dtype=torch.int8), torch.zeros(1, 3, 3).double())


def test_known_answers_on_a_wall() -> None:
    wall = Wall()
    x0 = np.array([[60.0, 80.0], [100.0, 120.0], [150.0, 200.0]])
    x1 = wall.partner(x0)
    line = np.column_stack([x0, np.ones(3)]) @ wall.pair.F.T
    along = np.stack([line[:, 1], -line[:, 0]], 1) / np.hypot(line[:, 0], line[:, 1])[:, None]
    for shift, expected in ((0.0, 1), (1.5, 1), (12.0, 0), (-12.0, 0)):
        moved = x1 + shift * along
        assert line_distance(wall.pair.F, x0, moved).max() < 1e-6  # no epipolar line can tell
        assert label(wall, wall.pair, x0, moved).tolist() == [expected] * 3
    ahead = transfer_error(x0, wall.depth(wall.pair.image0, x0)[None], x1, *_cameras(wall.pair))
    np.testing.assert_allclose(ahead, 0, atol=1e-9)


def _cameras(pair: ImagePair):  # type: ignore[no-untyped-def]
    return pair.K0, pair.K1, pair.R, pair.t


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
    forward = transfer_error(
        np.zeros((1, 2)), np.ones((1, 1)), np.zeros((1, 2)), K, K, np.eye(3), np.array([0, 0, -2.0])
    )
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
