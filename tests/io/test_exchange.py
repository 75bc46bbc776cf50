"""Keypoints, matches and geometries of other libraries are taken, and given back the same."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

import fmtorch
from fmtorch.features import keypoints_to_lafs
from fmtorch.geometry import sampson
from tests.laws import scene

pycolmap = pytest.importorskip("pycolmap")
K = torch.tensor([[800.0, 0, 479.5], [0, 800, 319.5], [0, 0, 1]], dtype=torch.float64)


@pytest.fixture(scope="module")
def points() -> tuple[Tensor, Tensor]:
    c = scene(0, 60)
    return c.x0[0], c.x1[0]


@pytest.fixture(scope="module")
def pose(points: tuple[Tensor, Tensor]) -> fmtorch.PoseEstimate:
    return fmtorch.find_essential(*points, K, K)


def keypoints(x: Tensor, turn: float) -> list[cv2.KeyPoint]:
    return [cv2.KeyPoint(float(a), float(b), 4.0 + i % 5, (10 * i + turn) % 360) for i, (a, b) in enumerate(x.tolist())]


def test_keypoints_and_matches_of_opencv(points: tuple[Tensor, Tensor]) -> None:
    keypoints0, keypoints1 = keypoints(points[0], 0), keypoints(points[1], 20)[::-1]
    n = len(keypoints0)
    best = [cv2.DMatch(i, n - 1 - i, 30.0 + i) for i in range(n)]
    given = fmtorch.from_opencv(keypoints0, keypoints1, best)
    assert given.keys() == {"x0", "x1", "lafs0", "lafs1"}
    torch.testing.assert_close(given["x1"], points[1].float())
    frames = keypoints_to_lafs(keypoints0)
    scale = frames[0, :, :2].det().sqrt() / given["lafs0"][0, :, :2].det().sqrt()
    torch.testing.assert_close(given["lafs0"][..., :2] * scale, frames[..., :2], atol=1e-4, rtol=1e-4)
    knn = [(match, cv2.DMatch(i, 0, 100.0)) for i, match in enumerate(best)] + [()]
    torch.testing.assert_close(fmtorch.from_opencv(keypoints0, keypoints1, knn)["ratio"][3], torch.tensor(0.33))
    assert fmtorch.find_fundamental(**given).inliers.shape == (1, n)
    assert fmtorch.from_opencv([], [], [])["x0"].shape == (0, 2)


def test_keypoints_without_orientation_have_no_frames(points: tuple[Tensor, Tensor]) -> None:
    ends = [[cv2.KeyPoint(float(a), float(b), 7.0) for a, b in x.tolist()] for x in points]
    given = fmtorch.from_opencv(*ends, [cv2.DMatch(i, i, 1.0) for i in range(len(ends[0]))])
    assert given.keys() == {"x0", "x1"}


@pytest.mark.parametrize("count", [None, 1, 2])
@pytest.mark.parametrize("listed", [False, True])
def test_dictionaries_of_lightglue(points: tuple[Tensor, Tensor], count: int | None, listed: bool) -> None:
    n = len(points[0])
    order = torch.randperm(n, generator=torch.Generator().manual_seed(0))
    partners = torch.argsort(order)
    partners[5] = -1
    kept = (partners > -1).nonzero()[:, 0]
    score = torch.linspace(0.1, 0.9, n)
    size = torch.tensor([960, 640])

    def batched(value: Tensor) -> Tensor:
        return value if count is None else value.expand(count, *value.shape)

    features0 = {"keypoints": batched(points[0]), "image_size": batched(size)}
    features1 = {"keypoints": batched(points[1][order]), "image_size": batched(size)}
    if listed:
        listed_values = {"matches": torch.stack([kept, partners[kept]], -1), "scores": score[kept]}
        matches = {name: value if count is None else [value] * count for name, value in listed_values.items()}
    else:
        matches = {"matches0": batched(partners), "matching_scores0": batched(score)}
    given = fmtorch.from_lightglue(features0, features1, matches)
    x0, x1 = (given[name][0] if count == 2 else given[name] for name in ("x0", "x1"))
    assert torch.equal(x0, points[0][kept])
    assert torch.equal(x1, points[1][kept])
    estimate = fmtorch.find_fundamental(**given)
    assert len(estimate) == (count or 1)
    assert bool(estimate.ok.all())
    assert given["size0"].reshape(-1).tolist()[:2] == [640, 960]


def test_dictionaries_of_kornia(points: tuple[Tensor, Tensor]) -> None:
    n = len(points[0])
    one = {"keypoints0": points[0], "keypoints1": points[1], "confidence": torch.full((n,), 0.7)}
    two = {name: torch.cat([value, value]) for name, value in one.items()}
    two["batch_indexes"] = torch.arange(2).repeat_interleave(n)
    first = fmtorch.find_fundamental(**fmtorch.from_kornia(one))
    both = fmtorch.find_fundamental(**fmtorch.from_kornia(two))
    assert torch.equal(both.F[1], first.F[0])


def test_a_geometry_of_colmap_and_back(points: tuple[Tensor, Tensor], pose: fmtorch.PoseEstimate) -> None:
    geometry = fmtorch.to_colmap(pose)
    assert geometry.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    shifted = sampson(torch.tensor(geometry.F)[None], points[0] + 0.5, points[1] + 0.5)
    torch.testing.assert_close(shifted, sampson(pose.F, *points), atol=1e-4, rtol=1e-4)
    again = fmtorch.from_colmap(geometry, len(points[0]))
    torch.testing.assert_close(sampson(again.F, *points), sampson(pose.F, *points), atol=1e-4, rtol=1e-4)
    assert torch.equal(again.inliers, pose.inliers)
    assert again.R is not None
    assert again.t is not None
    torch.testing.assert_close(again.R, pose.R.double())
    torch.testing.assert_close(again.t, pose.t.double())


def test_a_homography_of_colmap_and_back(points: tuple[Tensor, Tensor]) -> None:
    H = torch.tensor([[0.9, 0.1, 20], [-0.1, 0.9, 5], [1e-5, 0, 1]], dtype=torch.float64)
    x0 = points[0].double()
    x1 = torch.cat([x0, torch.ones(len(x0), 1)], 1) @ H.T
    estimate = fmtorch.find_homography(x0, x1[:, :2] / x1[:, 2:])
    geometry = fmtorch.to_colmap(estimate)
    assert geometry.F is None
    again = fmtorch.from_colmap(geometry, len(x0))
    torch.testing.assert_close(again.H / again.H[..., 2:, 2:], H[None], atol=1e-6, rtol=1e-6)


def test_what_is_no_geometry_is_degenerate_and_says_why(points: tuple[Tensor, Tensor]) -> None:
    geometry = fmtorch.to_colmap(fmtorch.find_fundamental(points[0][:5], points[1][:5]))
    assert geometry.config == pycolmap.TwoViewGeometryConfiguration.DEGENERATE
    again = fmtorch.from_colmap(geometry, 5)
    assert not bool(again.ok[0])
    assert again.reason == ("COLMAP calls it degenerate",)
    with pytest.raises(ValueError, match="to_colmap takes one pair, not 2"):
        fmtorch.to_colmap(fmtorch.find_fundamental([points[0]] * 2, [points[1]] * 2))


def test_a_pose_of_poselib_and_back(points: tuple[Tensor, Tensor], pose: fmtorch.PoseEstimate) -> None:
    pytest.importorskip("poselib")
    given = fmtorch.to_poselib(pose)
    np.testing.assert_allclose(given.R, pose.R[0].numpy(), atol=1e-12)
    again = fmtorch.from_poselib(given, pose.inliers[0].tolist(), K, K)
    torch.testing.assert_close(again.R, pose.R.double())
    exact = sampson(pose.F.double(), *points)[pose.inliers]
    torch.testing.assert_close(sampson(again.F, *points)[pose.inliers], exact, atol=1e-3, rtol=1e-3)
    with pytest.raises(ValueError, match="the estimate has no pose"):
        fmtorch.to_poselib(fmtorch.find_fundamental(*points))
