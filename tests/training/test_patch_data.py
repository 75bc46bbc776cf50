"""Training patches: warps, keypoints and the correspondences they give."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from fmtorch.scenes.textures import photograph
from fmtorch.training.correspondences import CONTEXT_SIZE, Tolerance, corresponding_patches, cut
from fmtorch.training.keypoints import dog_keypoints, hessian_keypoints
from fmtorch.training.patch_store import PatchStore, build_store
from fmtorch.training.photographs import Photograph, list_photographs, package_photographs, split
from fmtorch.training.warps import ViewRange, apply, local_affine, random_homography, warp


@pytest.fixture(scope="module")
def grey() -> np.ndarray:
    return cv2.cvtColor(photograph("chelsea.png"), cv2.COLOR_RGB2GRAY)


def test_a_view_contains_the_image_and_its_derivative_is_the_differences() -> None:
    for seed in range(20):
        H, (h, w) = random_homography(np.random.default_rng(seed), (300, 400), ViewRange())
        corners = apply(H, np.array([[0, 0], [399, 0], [0, 299], [399, 299.0]]))
        assert corners.min() > -1
        assert (corners.max(0) < np.array([w, h]) + 1).all()
        x = np.array([[120.0, 80.0]])
        step = 1e-4
        numeric = np.stack([(apply(H, x + d) - apply(H, x - d))[0] / (2 * step) for d in step * np.eye(2)], -1)
        np.testing.assert_allclose(local_affine(H, x)[0], numeric, atol=1e-6)


def test_a_warped_view_shows_what_the_homography_says(grey: np.ndarray) -> None:
    smooth = cv2.GaussianBlur(grey, (0, 0), 4)
    H, size = random_homography(np.random.default_rng(3), smooth.shape, ViewRange())
    view = warp(smooth, H, size)
    points = np.random.default_rng(0).uniform([40, 40], [smooth.shape[1] - 40, smooth.shape[0] - 40], (200, 2))
    there = apply(H, points)
    seen = cv2.remap(view, *there.astype(np.float32).T.reshape(2, -1, 1), cv2.INTER_LINEAR)[:, 0]
    truth = cv2.remap(smooth, *points.astype(np.float32).T.reshape(2, -1, 1), cv2.INTER_LINEAR)[:, 0]
    assert np.abs(seen.astype(float) - truth).mean() < 3  # grey levels; blur by reduction, rounding


def test_hessian_finds_blobs_with_their_scale() -> None:
    image = np.full((200, 300), 60.0)
    y, x = np.mgrid[:200, :300]
    blobs = [(60, 80, 4.0), (200, 100, 8.0), (120, 150, 6.0)]
    for bx, by, sigma in blobs:
        image += 150 * np.exp(-((x - bx) ** 2 + (y - by) ** 2) / (2 * sigma**2))
    found = hessian_keypoints(np.clip(image, 0, 255).astype(np.uint8), 3)
    for bx, by, sigma in blobs:
        near = found[np.hypot(found[:, 0] - bx, found[:, 1] - by) < 3]
        assert len(near) == 1
        assert abs(math.log2(near[0, 2] / sigma)) < 0.5  # det of a Gaussian blob is largest at its sigma


@pytest.mark.parametrize("detect", [dog_keypoints, hessian_keypoints])
def test_keypoints_turn_with_the_image(grey: np.ndarray, detect: object) -> None:
    grey = np.ascontiguousarray(grey[:257, :385])  # so that halving keeps the same pixels after the turn
    before, after = detect(grey, 300), detect(np.ascontiguousarray(np.rot90(grey, -1)), 300)  # type: ignore[operator]
    # clockwise: (x, y) -> (h - 1 - y, x), angles (x towards y) grow by 90 degrees
    moved = np.c_[grey.shape[0] - 1 - before[:, 1], before[:, 0]]
    apart = np.hypot(*(moved[:, None] - after[None, :, :2]).transpose(2, 0, 1))
    turn = (after[None, :, 3] - before[:, None, 3] - math.pi / 2 + math.pi) % (2 * math.pi) - math.pi
    same = (apart < 1.0) & (np.abs(np.log(after[None, :, 2] / before[:, None, 2])) < 0.1) & (np.abs(turn) < 0.1)
    assert same.any(1).mean() > 0.8


def test_patches_of_a_turned_image_are_the_same(grey: np.ndarray) -> None:
    points = np.array([[200.0, 150, 3, 0.4], [260, 120, 9, -2]])
    turned = np.c_[grey.shape[0] - 1 - points[:, 1], points[:, 0], points[:, 2], points[:, 3] + math.pi / 2]
    a = cut(grey, points, 64, 12.0)
    b = cut(np.ascontiguousarray(np.rot90(grey, -1)), turned, 64, 12.0)
    assert np.abs(a.astype(int) - b).mean() < 2
    assert a.std() > 10


def test_every_point_has_patches_that_resemble_one_another() -> None:
    patches, point = corresponding_patches(
        photograph("chelsea.png"), np.random.default_rng(0), views=6, points=150, limits=ViewRange(),
        tolerance=Tolerance(),
    )  # fmt: skip
    counts = np.bincount(point)
    assert counts.min() >= 2
    assert counts.max() <= 6
    assert (np.diff(point) >= 0).all()
    assert patches.shape == (len(point), CONTEXT_SIZE, CONTEXT_SIZE)
    flat = patches[:, 16:48, 16:48].reshape(len(patches), -1).astype(float)
    flat = (flat - flat.mean(1, keepdims=True)) / (flat.std(1, keepdims=True) + 1e-6)
    first, second = np.searchsorted(point, np.arange(len(counts))), np.searchsorted(point, np.arange(len(counts))) + 1
    same = (flat[first] * flat[second]).mean(1)
    other = (flat[first] * np.roll(flat[second], 1, 0)).mean(1)
    assert np.median(same) > 0.6 > 0.3 > np.median(other)


def test_a_store_is_complete_deterministic_and_gives_two_different_views(tmp_path: Path) -> None:
    names = package_photographs()[:2]
    options = {"seed": 5, "views": 4, "points": 40, "longest_side": 300}
    store = build_store(tmp_path / "a", names, **options)  # type: ignore[arg-type]
    again = build_store(tmp_path / "b", names, workers=2, **options)  # type: ignore[arg-type]
    np.testing.assert_array_equal(store.patches, again.patches)
    np.testing.assert_array_equal(store.first, again.first)
    assert store.first[-1] == len(store.patches)
    assert store.description["photographs"] == {"scikit-image": 2}
    with pytest.raises(FileExistsError, match="delete it"):
        build_store(tmp_path / "a", names, **options)  # type: ignore[arg-type]
    assert {p.name for p in tmp_path.iterdir()} == {"a", "b"}
    points = torch.arange(len(store)).repeat_interleave(50)
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
        build_store(tmp_path / "s", [Photograph(tmp_path / "bad.jpg", "x")], seed=0, views=2, points=10)
    assert not (tmp_path / "s").exists()
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
    (tmp_path / "sources.txt").write_text("# file width height source path\n1.jpg 4 4 who/what images/x one.jpg\n")
    (only,) = list_photographs(tmp_path, ["who/what"])
    assert only == Photograph(tmp_path / "1.jpg", "who/what")
    with pytest.raises(ValueError, match="none of its 1 photographs"):
        list_photographs(tmp_path, None, ["images/x one"])
    with pytest.raises(FileNotFoundError, match="no folder"):
        list_photographs(tmp_path / "absent")
