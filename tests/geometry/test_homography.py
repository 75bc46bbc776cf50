"""Homographies equal their definitions, and stay where they are in any batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmtorch.geometry.homography import (
    least_squares_homography,
    plane_and_parallax,
    plane_homography,
    transfer_squared,
)
from tests.reference import homography as reference

BATCH = 12


def _planar(n: int, noise: float = 0.0) -> tuple[torch.Tensor, np.ndarray]:
    """Matches (4, BATCH, n) of about unit scale on a plane of their own each, and their homographies."""
    rng = np.random.default_rng(n)
    H = np.eye(3) + rng.uniform(-0.3, 0.3, (BATCH, 3, 3))
    x0 = rng.uniform(-1, 1, (BATCH, n, 2))
    y = np.concatenate([x0, np.ones((BATCH, n, 1))], -1) @ H.transpose(0, 2, 1)
    x1 = y[..., :2] / y[..., 2:] + noise * rng.normal(size=x0.shape)
    return torch.from_numpy(np.concatenate([x0, x1], -1)).permute(2, 0, 1).contiguous(), H


def _matrix(H: torch.Tensor) -> np.ndarray:
    return reference.unit(H.numpy().reshape(3, 3))


def _pairs(points: torch.Tensor, i: int) -> tuple[np.ndarray, np.ndarray]:
    return points[:2, i].T.numpy(), points[2:, i].T.numpy()


def _skew(e: np.ndarray) -> np.ndarray:
    return np.array([[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]])


def test_least_squares() -> None:
    points, _ = _planar(40, noise=0.01)
    weight = torch.rand(BATCH, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    weight[:, 30:] = 0
    H, determined = least_squares_homography(points, weight)
    assert bool(determined.all())
    for i in range(BATCH):
        # M squares the condition of the equations (some 10): rounding of 40 sums times 1e2 over the gap.
        np.testing.assert_allclose(_matrix(H[:, i]), reference.dlt(*_pairs(points, i), weight[i].numpy()), atol=1e-11)
    alone = [least_squares_homography(points[:, i : i + 1], weight[i : i + 1])[0] for i in range(BATCH)]
    assert torch.equal(torch.cat(alone, 1), H)
    assert torch.equal(least_squares_homography(points[..., :30].contiguous(), weight[:, :30])[0], H)
    assert not bool(least_squares_homography(points, torch.zeros_like(weight))[1].any())


def test_transfer_distance() -> None:
    points, H = _planar(20, noise=0.05)
    models = torch.from_numpy(H).flatten(1).T[..., None].contiguous()
    squared = transfer_squared(models, points)[:, 0]
    for i in range(BATCH):
        expected = [reference.transfer(H[i], a, b) ** 2 for a, b in zip(*_pairs(points, i), strict=True)]
        np.testing.assert_allclose(squared[i].numpy(), expected, rtol=1e-9)
    assert bool(torch.isinf(transfer_squared(torch.zeros(9, BATCH, 1, dtype=torch.float64), points)).all())


def test_plane_through_three_matches_of_a_fundamental_matrix() -> None:
    points, H = _planar(3)
    e1 = np.random.default_rng(1).normal(size=(BATCH, 3))
    F = np.stack([_skew(e) @ h for e, h in zip(e1, H, strict=True)])
    found, valid = plane_homography(
        torch.from_numpy(F).flatten(1).T.contiguous(), torch.from_numpy(e1).T.contiguous(),
        points.transpose(1, 2).contiguous(),
    )  # fmt: skip
    assert bool(valid.all())
    for i in range(BATCH):
        np.testing.assert_allclose(_matrix(found[:, i]), reference.unit(H[i]), atol=1e-9)
        np.testing.assert_allclose(_matrix(found[:, i]), reference.through_plane(F[i], *_pairs(points, i)), atol=1e-9)


def test_plane_and_parallax() -> None:
    _, H = _planar(4)
    rng = np.random.default_rng(2)
    points = torch.from_numpy(rng.uniform(-1, 1, (4, 2, BATCH)))
    F, valid = plane_and_parallax(torch.from_numpy(H).flatten(1).T.contiguous(), points)
    assert bool(valid.all())
    for i in range(BATCH):
        x0, x1 = points[:2, :, i].T.numpy(), points[2:, :, i].T.numpy()
        np.testing.assert_allclose(_matrix(F[:, i]), reference.plane_and_parallax(H[i], x0, x1), atol=1e-10)
    same = points.clone()
    same[:, 1] = same[:, 0]
    F, valid = plane_and_parallax(torch.from_numpy(H).flatten(1).T.contiguous(), same)
    assert not bool(valid.any())
    assert bool((F == 0).all())


@pytest.mark.parametrize("position", [0, 5, 11])
def test_neighbours_are_invisible(position: int) -> None:
    points, H = _planar(4, noise=0.1)
    samples = points.transpose(1, 2).contiguous()
    one = slice(position, position + 1)
    models = torch.from_numpy(H).flatten(1).T.contiguous()
    e1 = torch.randn(3, BATCH, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    triplet, pair = samples[:, :3].contiguous(), samples[:, :2].contiguous()
    whole = plane_homography(models, e1, triplet)[0][:, one]
    assert torch.equal(whole, plane_homography(models[:, one], e1[:, one], triplet[..., one])[0])
    whole = plane_and_parallax(models, pair)[0][:, one]
    assert torch.equal(whole, plane_and_parallax(models[:, one], pair[..., one])[0])
