"""Training patches of rendered scenes: where a point of one photograph is in another."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from fmtorch.scenes.camera import Camera, calibration, fundamental, look_at
from fmtorch.scenes.generate import Plan, Task
from fmtorch.training.correspondences import Tolerance, near
from fmtorch.training.patch_store import PatchStore, build_store
from fmtorch.training.scenes import View, linked, patches_of_scene, training_scenes, transferred

SIZE = (240, 320)
WALL, SCREEN = 4.0, 2.5  # metres in front of the first camera: the wall everywhere, the screen left of its middle


def camera(x: float, turn: float = 0.0) -> Camera:
    """At (x, 0, 0), looking along the y axis, a little to the side."""
    return look_at(calibration(300.0, SIZE), SIZE, (x, 0.0, 0.0), (x + np.sin(turn), np.cos(turn), 0.0))


def view(x: float, turn: float = 0.0) -> View:
    """What a camera sees of the wall y = WALL and the screen y = SCREEN, x < 0; keypoints on a grid."""
    c = camera(x, turn)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(c.K).T @ c.R
    screen, wall = SCREEN / rays[..., 1], WALL / rays[..., 1]
    hit = c.centre[0] + screen * rays[..., 0] < 0
    grid = np.stack(np.meshgrid(np.arange(10.0, 310, 7.3), np.arange(10.0, 230, 7.3)), -1).reshape(-1, 2)
    keypoints = np.c_[grid, np.full(len(grid), 2.0), np.linspace(-3, 3, len(grid))]
    return View(np.zeros(SIZE, np.uint8), c, 1 / np.where(hit, screen, wall), keypoints)


def test_points_are_where_the_surfaces_put_them() -> None:
    a, b = view(0.0), view(-0.6, 0.15)
    there, seen = transferred(a.keypoints, a, b)
    x = a.keypoints[:, 0]
    left = x < (SIZE[1] - 1) / 2
    world = np.linalg.inv(a.camera.K) @ np.c_[a.keypoints[:, :2], np.ones(len(x))].T
    world = (np.where(left, SCREEN, WALL) * world).T @ a.camera.R
    expected, _ = b.camera.project(world)
    np.testing.assert_allclose(there[seen, :2], expected[seen], atol=1e-6)
    h0, h1 = (np.c_[p[seen, :2], np.ones(seen.sum())] for p in (a.keypoints, there))
    line = h0 @ fundamental(a.camera, b.camera).T
    assert np.abs((h1 * line).sum(1) / np.hypot(line[:, 0], line[:, 1])).max() < 1e-6
    assert not seen[np.abs(x - (SIZE[1] - 1) / 2) < 1.5].any()  # on the screen's edge
    # Behind the screen as the second camera sees it, or outside its picture: hidden; the rest is seen.
    from_b = (world - b.camera.centre) / (world - b.camera.centre)[:, 1:2]
    behind = ~left & (b.camera.centre[0] + SCREEN * from_b[:, 0] < 0)
    inside = (expected > 2).all(1) & (expected < np.array(SIZE[::-1]) - 3).all(1)
    away = np.abs(x - (SIZE[1] - 1) / 2) > 4
    assert behind.any()
    assert not seen[behind & away].any()
    free = ~behind & inside & away & (np.abs(b.camera.centre[0] + SCREEN * from_b[:, 0]) > 0.05)
    assert free.sum() > 300
    assert seen[free].all()


def test_scale_and_orientation_are_those_of_the_derivative() -> None:
    a, b = view(0.0), view(0.6, -0.15)
    there, seen = transferred(a.keypoints, a, b)
    step = 0.01
    for axis, shift in enumerate(step * np.eye(2)):
        moved = a.keypoints.copy()
        moved[:, :2] += shift
        moved[:, 3] = 0.0 if axis == 0 else np.pi / 2
        still = a.keypoints.copy()
        still[:, 3] = moved[:, 3]
        beside, also = transferred(moved, a, b)
        turned = transferred(still, a, b)[0]
        both = seen & also
        d = (beside - there)[both, :2]
        error = (np.arctan2(d[:, 1], d[:, 0]) - turned[both, 3] + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(error).max() < 1e-2
    # The same plane seen straight from twice as far is half as large.
    far = Camera(a.camera.K, a.camera.R, a.camera.t + np.array([0.0, 0.0, WALL]), SIZE)
    wall = View(a.image, a.camera, np.full(SIZE, 1 / WALL), a.keypoints)
    halved, seen = transferred(wall.keypoints, wall, View(a.image, far, np.full(SIZE, 0.5 / WALL), a.keypoints))
    assert seen.any()
    np.testing.assert_allclose(halved[seen, 2], 1.0)
    np.testing.assert_allclose(halved[seen, 3], a.keypoints[seen, 3])


def test_points_are_linked_once_and_are_not_near_each_other() -> None:
    rng = np.random.default_rng(0)
    first, views = view(0.0), []
    for x, turn in ((0.0, 0.0), (0.4, -0.1), (0.8, -0.2)):
        v = view(x, turn)
        there, seen = transferred(first.keypoints, first, v)
        found = there[seen] + rng.normal(0, 0.1, (seen.sum(), 4)) * [1, 1, 0.1, 0.1]
        extra = np.c_[rng.uniform(20, 200, (40, 2)), np.full(40, 3.0), rng.uniform(-3, 3, 40)]
        views.append(View(v.image, v.camera, v.inverse_depth, np.concatenate([found, extra])))
    owners = linked(views, Tolerance())
    for owner in owners:
        shown = owner[owner >= 0]
        assert len(np.unique(shown)) == len(shown)
    counts = np.bincount(np.concatenate(owners)[np.concatenate(owners) >= 0])
    assert (counts == 3).sum() > 300
    for a, mine in zip(views, owners, strict=True):
        for b, theirs in zip(views, owners, strict=True):
            there, seen = transferred(a.keypoints, a, b)
            i, j, _ = near(there[seen], b.keypoints, Tolerance())
            one, other = mine[seen][i], theirs[j]
            # What is as near as one point can be is one point, but for what chance put between two of them.
            assert (one == other)[(one >= 0) & (other >= 0)].mean() > 0.97


def test_patches_of_a_scene(tmp_path: Path) -> None:
    task = Task("indoor", "train", 0, 3, Plan(1, 3, 0, scale=0.4))
    one, owner = patches_of_scene(task, np.random.default_rng((0, 0)), points=150, tolerance=Tolerance())
    assert one.dtype == np.uint8
    assert len(one) == len(owner) > 40
    assert (np.bincount(owner) >= 2).all()
    assert (np.diff(owner) >= 0).all()
    shown, hidden = [], []
    for k in range(owner.max() + 1):
        a, b = one[owner == k][:2].astype(float).reshape(2, -1)
        c = one[owner == (k + 7) % (owner.max() + 1)][0].astype(float).ravel()
        shown.append(np.corrcoef(a, b)[0, 1])
        hidden.append(np.corrcoef(a, c)[0, 1])
    assert np.median(shown) > 0.6
    assert np.median(hidden) < 0.3
    store = build_store(tmp_path / "store", [], seed=0, views=3, points=150, scenes=[task])
    assert isinstance(store, PatchStore)
    np.testing.assert_array_equal(store.patches, one)
    assert json.loads((tmp_path / "store" / "store.json").read_text())["scenes"] == {"indoor": 1}


def test_training_scenes_are_of_the_training_side() -> None:
    tasks = training_scenes(2, 5, 1)
    assert len(tasks) == 8
    assert len({task.name for task in tasks}) == 8
    assert all(task.split == "train" and task.plan.shots == 5 for task in tasks)
