"""Which matches lie in front of both cameras: as by triangulation, whatever signs the factors of E have."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmtorch.estimators.models.model import BITS, cheirality
from fmtorch.estimators.models.posterior import Cameras
from fmtorch.geometry.levenberg_marquardt import LOSS_CODES, NO_TABLE, Weighted
from tests.reference import focal as reference


def factors(seed: int) -> tuple[np.random.Generator, np.ndarray, np.ndarray, np.ndarray]:
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


def share(
    U: np.ndarray, V: np.ndarray, focal: np.ndarray, points: np.ndarray, support: np.ndarray, tolerance: float
) -> float:
    """Of exact points (4, n), whose gain is one."""
    K0, K1 = (np.diag([1 / f, 1 / f, 1]) for f in focal)
    F, out = (K1 @ U @ np.diag([1, 1, 0]) @ V.T @ K0).reshape(1, 9), np.empty(1)
    cameras = Cameras(np.stack([U, V])[None].copy(), np.log(focal)[None])
    matches = Weighted(points, support, np.full(len(support), 1e4), LOSS_CODES["geman_mcclure"], NO_TABLE)
    cheirality(cameras, np.ones(2), F, matches, tolerance, out)
    return float(out[0])


@pytest.mark.parametrize("tolerance", [0.0, 0.02])
@pytest.mark.parametrize("seed", range(12))
def test_as_by_triangulation(seed: int, tolerance: float) -> None:
    rng, E, U, V = factors(seed)
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
    computed = share(U, V, focal, points, support, tolerance)
    expected = reference.share_in_front(E, rays0, rays1, support, np.full(n, tolerance / focal[1]))
    # Supports are rounded to BITS, those of gains that rounding leaves a little below one.
    assert computed == pytest.approx(expected, abs=n * 2.0**-BITS / support.sum())
    assert 0.25 <= computed < 0.95  # neither all nor none, so that the comparison tells


def test_support_is_the_gain_of_geman_and_mcclure() -> None:
    """Matches off their lines count less, beyond five scales not at all: the rest is that of exact ones."""
    rng, E, U, V = factors(0)
    points = rng.uniform(-0.8, 0.8, (4, 60))
    weight, ones = rng.random(60), np.ones(2)
    h0, h1 = np.c_[points[:2].T, np.ones(60)], np.c_[points[2:].T, np.ones(60)]
    l1, l0 = h0 @ E.T, h1 @ E
    r2 = (h1 * l1).sum(1) ** 2 / (l1[:, :2] ** 2 + l0[:, :2] ** 2).sum(1)
    scale = 30.0
    gain = np.maximum(1 / (1 + r2 * scale) - 1 / 26, 0) / (1 - 1 / 26)
    cameras, out = Cameras(np.stack([U, V])[None].copy(), np.zeros((1, 2))), np.empty(1)
    loss, F = LOSS_CODES["geman_mcclure"], (U @ np.diag([1, 1, 0]) @ V.T).reshape(1, 9)
    cheirality(cameras, ones, F, Weighted(points, weight, np.full(60, scale), loss, NO_TABLE), 0.0, out)
    computed = out[0]
    # The same, each match weighted by its gain, with a scale so small that all count fully.
    cheirality(cameras, ones, F, Weighted(points, weight * gain, np.full(60, 1e-12), loss, NO_TABLE), 0.0, out)
    assert computed == pytest.approx(out[0], abs=60 * 2.0**-BITS / (weight * gain).sum())
