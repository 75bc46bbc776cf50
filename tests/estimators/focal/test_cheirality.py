"""Which matches lie in front of both cameras: as by triangulation, whatever signs the factors of E have."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fmtorch.estimators.focal.cheirality import share_in_front
from tests.reference import cheirality as reference


def _cameras(seed: int) -> tuple[np.random.Generator, np.ndarray, np.ndarray, np.ndarray]:
    """A generator, E of random cameras, and factors of it with random signs and a random turn."""
    rng = np.random.default_rng(seed)
    t, R = rng.normal(size=3), Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
    E = np.cross(np.eye(3), -t / np.linalg.norm(t)) @ R
    U, _, Vt = np.linalg.svd(E)
    turn = np.eye(3)
    angle = rng.uniform(0, 2 * np.pi)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    U, V = U @ turn, Vt.T @ turn  # of a double singular value
    return rng, E, U * [1, 1, rng.choice([-1, 1])], V * [1, 1, rng.choice([-1, 1])]


@pytest.mark.parametrize("tolerance", [0.0, 0.02])
@pytest.mark.parametrize("seed", range(12))
def test_as_by_triangulation(seed: int, tolerance: float) -> None:
    rng, E, U, V = _cameras(seed)
    assert np.allclose(U @ np.diag([1, 1, 0]) @ V.T, E) or np.allclose(U @ np.diag([1, 1, 0]) @ V.T, -E)
    n, focal = 80, rng.uniform(0.8, 2, 2)
    x0 = rng.uniform(-0.8, 0.8, (n, 2))
    rays0 = np.c_[x0 / focal[0], np.ones(n)]
    # Points of image 1 on the epipolar lines, anywhere: about a quarter lie in front of each of the four camera pairs.
    lines = rays0 @ E.T
    x1 = rng.uniform(-0.8, 0.8, n)
    rays1 = np.c_[x1 / focal[1], -(lines[:, 0] * x1 / focal[1] + lines[:, 2]) / lines[:, 1], np.ones(n)]
    support = rng.integers(1, 1 << 10, n) / (1 << 10)  # of few bits: their sums are exact
    points = np.stack([*x0.T, *(rays1[:, :2] * focal[1]).T])
    found = share_in_front(
        torch.from_numpy(U)[..., None, None],
        torch.from_numpy(V)[..., None, None],
        torch.from_numpy(focal)[:, None, None],
        torch.from_numpy(points)[:, None],
        torch.from_numpy(support)[None, None],
        torch.tensor([tolerance], dtype=torch.float64),
    )
    expected = reference.share_in_front(E, rays0, rays1, support, np.full(n, tolerance / focal[1]))
    assert float(found) == pytest.approx(expected, abs=1e-12)
    assert 0.25 <= float(found) < 0.95  # neither all nor none, so that the comparison tells


def test_without_support_there_is_no_share() -> None:
    _, _, U, V = _cameras(0)
    one = torch.ones(2, 1, 1, dtype=torch.float64)
    points, support = torch.rand(4, 1, 9, dtype=torch.float64), torch.zeros(1, 1, 9, dtype=torch.float64)
    U_, V_ = (torch.from_numpy(M)[..., None, None] for M in (U, V))
    assert share_in_front(U_, V_, one, points, support, torch.zeros(1, dtype=torch.float64)).isnan().all()
