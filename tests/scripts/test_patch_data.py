"""Training patches: warps, keypoints, rendered scenes and planes, and the correspondences that they give."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from fmtorch.scenes import Camera, Plan, Task, calibration, fundamental, look_at, photograph
from fmtorch.training.options import PlaneViews
from fmtorch.training.planes import Photograph, list_photographs
from scripts.patch_networks.patches import Tolerance, View, Warps, tracks_of_views, transferred, views_of_plane
from scripts.patch_networks.stores import Cutting, PatchStore, build_store, package_photographs, split

SIZE = (240, 320)
WALL, SCREEN = 4.0, 2.5  # metres in front of the first camera: the wall everywhere, the screen left of its middle
PLANES = PlaneViews(views=4, tilt=15.0, scale=(0.5, 0.6))


def correlations(patches: np.ndarray, point: np.ndarray) -> tuple[float, float]:
    """Median correlation of two patches of a point, and of patches of different points."""
    flat = patches[:, 16:48, 16:48].reshape(len(patches), -1).astype(float)
    flat = (flat - flat.mean(1, keepdims=True)) / (flat.std(1, keepdims=True) + 1e-6)
    first = np.searchsorted(point, np.arange(point.max() + 1))
    a, b = flat[first], flat[first + 1]
    return float(np.median((a * b).mean(1))), float(np.median((a * np.roll(b, 1, 0)).mean(1)))


def test_a_store_is_complete_deterministic_and_gives_two_different_views(tmp_path: Path) -> None:
    names, cutting = package_photographs()[:2], Cutting(Warps(views=4), 40, longest_side=300)
    task = Task("indoor", "train", 0, 3, Plan(1, 3, 0, scale=0.4))
    store = build_store(tmp_path / "a", names, cutting, seed=5, scenes=[task])
    again = build_store(tmp_path / "b", names, cutting, seed=5, scenes=[task], workers=2)
    np.testing.assert_array_equal(store.patches, again.patches)
    np.testing.assert_array_equal(store.first, again.first)
    assert store.first[-1] == len(store.patches)
    assert store.tracks is None
    told = json.loads((tmp_path / "a" / "store.json").read_text())
    assert (told["photographs"], told["scenes"]) == ({"scikit-image": 2}, {"indoor": 1})
    with pytest.raises(FileExistsError, match="delete it"):
        build_store(tmp_path / "a", names, cutting, seed=5)
    assert {p.name for p in tmp_path.iterdir()} == {"a", "b"}
    points = torch.arange(len(store)).repeat_interleave(20)
    draws = torch.rand(len(points), 2, generator=torch.Generator().manual_seed(0))
    for i, (a, b) in enumerate(zip(*store.views(points, draws), strict=True)):
        mine = torch.from_numpy(store.patches[store.first[points[i]] : store.first[points[i] + 1]].copy()).float() / 255
        shown = [int((mine - x).abs().sum((1, 2)).argmin()) for x in (a, b)]
        assert torch.equal(mine[shown[0]], a[0])
        assert torch.equal(mine[shown[1]], b[0])
        assert shown[0] != shown[1]


def test_an_unreadable_photograph_leaves_no_store(tmp_path: Path) -> None:
    (tmp_path / "bad.jpg").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"bad\.jpg"):
        build_store(tmp_path / "s", [Photograph(tmp_path / "bad.jpg", "x")], Cutting(Warps(views=2), 10), seed=0)
    assert [p.name for p in tmp_path.iterdir()] == ["bad.jpg"]
    with pytest.raises(FileNotFoundError, match="holds no patches"):
        PatchStore.open(tmp_path / "s")


def test_photographs_are_split_by_source(tmp_path: Path) -> None:
    for name in ("a/1.jpg", "a/2.png", "b/3.jpg", "4.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.new("L", (4, 4)).save(tmp_path / name)
    found = list_photographs(tmp_path)
    assert sorted((p.path.name, p.source) for p in found) == [
        ("1.jpg", "a"), ("2.png", "a"), ("3.jpg", "b"), ("4.jpg", "4.jpg"),
    ]  # fmt: skip
    train, validation = split(found, ["a"])
    assert {p.source for p in train} == {"b", "4.jpg"}
    assert {p.path.name for p in validation} == {"1.jpg", "2.png"}
    with pytest.raises(ValueError, match=r"held_out names c; the sources are 4\.jpg, a, b"):
        split(found, ["c"])
    with pytest.raises(ValueError, match="both sides"):
        split(found, ["a", "b", "4.jpg"])


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


def world_points(v: View) -> np.ndarray:
    """Where the keypoints of `view` lie: on the screen y = SCREEN, x < 0, or on the wall y = WALL."""
    rays = np.c_[v.keypoints[:, :2], np.ones(len(v.keypoints))] @ np.linalg.inv(v.camera.K).T @ v.camera.R
    screen, wall = (v.camera.centre + (y - v.camera.centre[1]) / rays[:, 1:2] * rays for y in (SCREEN, WALL))
    return np.where(screen[:, :1] < 0, screen, wall)


def test_points_are_where_the_surfaces_put_them() -> None:
    a, b = view(0.0), view(-0.6, 0.15)
    there, seen = transferred(a.keypoints, a, b)
    x = a.keypoints[:, 0]
    world = world_points(a)
    expected, _ = b.camera.project(world)
    np.testing.assert_allclose(there[seen, :2], expected[seen], atol=1e-6)
    h0, h1 = (np.c_[p[seen, :2], np.ones(seen.sum())] for p in (a.keypoints, there))
    line = h0 @ fundamental(a.camera, b.camera).T
    assert np.abs((h1 * line).sum(1) / np.hypot(line[:, 0], line[:, 1])).max() < 1e-6
    assert not seen[np.abs(x - (SIZE[1] - 1) / 2) < 1.5].any()  # on the screen's edge
    # Behind the screen as the second camera sees it, or outside its picture: hidden; the rest is seen.
    from_b = (world - b.camera.centre) / (world - b.camera.centre)[:, 1:2]
    behind = (x >= (SIZE[1] - 1) / 2) & (b.camera.centre[0] + SCREEN * from_b[:, 0] < 0)
    inside = (expected > 2).all(1) & (expected < np.array(SIZE[::-1]) - 3).all(1)
    away = np.abs(x - (SIZE[1] - 1) / 2) > 4
    assert behind.any()
    assert not seen[behind & away].any()
    free = ~behind & inside & away & (np.abs(b.camera.centre[0] + SCREEN * from_b[:, 0]) > 0.05)
    assert free.sum() > 300
    assert seen[free].all()


def test_tracks_of_a_plane_show_the_same_point_under_its_angles() -> None:
    views = views_of_plane(photograph("chelsea.png"), np.random.default_rng(0), PLANES, points=150)
    patches, point, columns = tracks_of_views(views, Tolerance())
    same, other = correlations(patches, point)
    assert same > 0.6 > 0.3 > other
    # The plane is z = 0, seen from z < 0: its normal is (0, 0, -1).
    angles = np.degrees(np.arccos(-columns["rays"][:, 2]))
    np.testing.assert_allclose(columns["incidence"], angles, atol=0.02)  # float32 rays: eps / sin
