"""Homographies equal their definitions."""

from __future__ import annotations

import numpy as np

from fmtorch.geometry.homography import (
    least_squares_homography as compiled_least_squares_homography,
)
from fmtorch.geometry.homography import (
    near_plane as compiled_near_plane,
)
from fmtorch.geometry.homography import (
    plane_and_parallax as compiled_plane_and_parallax,
)
from fmtorch.geometry.homography import (
    plane_homography as compiled_plane_homography,
)
from fmtorch.jit.kernel import B1x1, F8x1, F8x2, I8x1, kernel
from tests.reference import homography as reference
from tests.reference.solvers import skew

PROBLEMS = 12


@kernel
def least_squares_homography(points: F8x2, inside: B1x1, H: F8x1) -> bool:
    return compiled_least_squares_homography(points, inside, H)


@kernel
def plane_homography(F: F8x1, e1: F8x1, points: F8x2, triplet: I8x1, H: F8x1) -> bool:
    return compiled_plane_homography(F, e1, points, triplet, H)


@kernel
def plane_and_parallax(H: F8x1, points: F8x2, i: int, j: int, F: F8x1) -> bool:
    return compiled_plane_and_parallax(H, points, i, j, F)


@kernel
def near_plane(H: F8x1, points: F8x2, limit: float, out: B1x1) -> int:
    return compiled_near_plane(H, points, limit, out)


def planar(seed: int, n: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Matches (4, n) of about unit scale on a plane, and their homography."""
    rng = np.random.default_rng([seed, n])
    H = np.eye(3) + rng.uniform(-0.3, 0.3, (3, 3))
    x0 = rng.uniform(-1, 1, (n, 2))
    y = np.c_[x0, np.ones(n)] @ H.T
    return np.ascontiguousarray(np.c_[x0, y[:, :2] / y[:, 2:] + noise * rng.normal(size=x0.shape)].T), H


def test_least_squares() -> None:
    for seed in range(PROBLEMS):
        points, _ = planar(seed, 40, noise=0.01)
        inside, H = np.arange(40) < 30, np.empty(9)
        assert least_squares_homography(points, inside, H)
        expected = reference.dlt(points[:2, :30].T, points[2:, :30].T)
        # M squares the condition of the equations (some 10): rounding of 40 sums times 1e2 over the gap.
        np.testing.assert_allclose(reference.unit(H.reshape(3, 3)), expected, atol=1e-11)
    assert not least_squares_homography(points, np.zeros(40, bool), H)


def test_matches_near_a_plane() -> None:
    for seed in range(PROBLEMS):
        points, H = planar(seed, 60, noise=0.05)
        expected = [reference.transfer(H, x[:2], x[2:]) for x in points.T]
        near = np.empty(60, bool)
        assert near_plane(H.ravel().copy(), points, 0.1**2, near) == np.count_nonzero(near)
        np.testing.assert_array_equal(near, np.array(expected) <= 0.1)
    assert near_plane(np.zeros(9), points, 1.0, near) == 0


def test_plane_through_three_matches_of_a_fundamental_matrix() -> None:
    for seed in range(PROBLEMS):
        points, truth = planar(seed, 5)
        e1, H = np.random.default_rng(seed).normal(size=3), np.empty(9)
        F = skew(e1) @ truth
        assert plane_homography(F.ravel(), e1, points, np.array([1, 4, 2]), H)
        plane = reference.unit(H.reshape(3, 3))
        np.testing.assert_allclose(plane, reference.unit(truth), atol=1e-9)
        x0, x1 = points[:2, [1, 4, 2]].T, points[2:, [1, 4, 2]].T
        np.testing.assert_allclose(plane, reference.through_plane(F, x0, x1), atol=1e-9)
    assert not plane_homography(F.ravel(), e1, points, np.array([1, 1, 2]), H)


def test_plane_and_parallax() -> None:
    for seed in range(PROBLEMS):
        _, H = planar(seed, 4)
        points, F = np.random.default_rng(seed).uniform(-1, 1, (4, 5)), np.empty(9)
        assert plane_and_parallax(H.ravel(), points, 3, 1, F)
        expected = reference.plane_and_parallax(H, points[:2, [3, 1]].T, points[2:, [3, 1]].T)
        np.testing.assert_allclose(reference.unit(F.reshape(3, 3)), expected, atol=1e-10)
        assert not plane_and_parallax(H.ravel(), points, 2, 2, F)
