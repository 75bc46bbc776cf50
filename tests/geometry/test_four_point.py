"""Homographies of four matches equal their definition; degenerate samples give none."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from fmtorch.compiling.lanes import LANES
from fmtorch.geometry.four_point_kernels import four_point
from tests.geometry.test_homography import planar
from tests.reference import homography as reference

EPS32 = float(np.finfo(np.float32).eps)


def solved(points: np.ndarray, sample: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Models (m, 9) of samples (4, s), and their draws."""
    H, draw = np.empty((sample.shape[1], 9), np.float32), np.empty(sample.shape[1], np.int64)
    count = four_point(points, np.ascontiguousarray(sample), H, draw)
    return H[:count], draw[:count]


@pytest.mark.parametrize("samples", [1, LANES - 1, LANES, 3 * LANES + 5])
def test_four_matches(samples: int) -> None:
    rng = np.random.default_rng(samples)
    points, _ = planar(0, 60, noise=0.2)
    sample = np.stack([rng.permutation(60)[:4] for _ in range(samples)], 1)
    H, draw = solved(points, sample)
    expected = [reference.four_point(points[:2, s].T, points[2:, s].T) for s in sample.T]
    assert draw.tolist() == [i for i, model in enumerate(expected) if model is not None]
    for model, i in zip(H, draw, strict=True):
        # Where a triangle is thin in an image, rounding of the reference's equations grows with its slenderness.
        thinnest = min(np.abs(reference.areas(points[k : k + 2, sample[:, i]].T)).min() for k in (0, 2))
        np.testing.assert_allclose(model, expected[i].ravel(), atol=4 * EPS32 + 1e-13 / thinnest**2)  # type: ignore[union-attr]


def test_models_through_exact_matches_are_the_truth_at_any_scale() -> None:
    points, truth = planar(1, 40)
    truth = truth / np.linalg.norm(truth) * np.sign(truth[2, 2])
    sample = np.stack([np.random.default_rng(i).permutation(40)[:4] for i in range(50)], 1)
    for scale in (1e-9, 1.0, 1e9):
        H, draw = solved(points * scale, sample)
        assert len(draw) == 50
        D = np.diag([scale, scale, 1.0])
        expected = D @ truth @ np.linalg.inv(D)
        np.testing.assert_allclose(H, np.tile(expected.ravel() / np.linalg.norm(expected), (50, 1)), atol=1e-5)


@pytest.mark.parametrize("image", [0, 1])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_three_points_on_a_line_and_coincident_points_give_no_model(image: int, scale: float) -> None:
    points, _ = planar(2, 4)
    rows = slice(2 * image, 2 * image + 2)
    for a, b, c in itertools.permutations(range(4), 3):
        line, coincident = points.copy(), points.copy()
        line[rows, c] = 0.3 * points[rows, a] + 0.7 * points[rows, b]
        coincident[rows, c] = points[rows, a]
        for degenerate in (line, coincident, np.zeros_like(points)):
            assert not len(solved(degenerate * scale, np.arange(4)[:, None])[0])
    repeated = np.array([[0], [1], [2], [2]])
    assert not len(solved(points * scale, repeated)[0])
    assert not len(solved(np.full_like(points, np.nan), np.arange(4)[:, None])[0])


def test_planes_seen_from_behind_give_no_model() -> None:
    points, _ = planar(3, 4)
    assert len(solved(points, np.arange(4)[:, None])[0]) == 1
    assert not len(solved(points * [[1], [1], [-1], [1]], np.arange(4)[:, None])[0])
