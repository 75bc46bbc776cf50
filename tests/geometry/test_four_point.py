"""Homographies of four matches equal the DLT of the definitions; samples that determine none give none."""

import itertools

import numpy as np
import pytest

from fmtorch.geometry.homography import four_point
from tests.reference import homography as reference

ROUNDING32, ROUNDING64 = 2.0**-24, 2.0**-53


def solved(points: np.ndarray, sample: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H (m, 9) and draw (m,) of samples (4, s)."""
    H, draw = np.full((sample.shape[1], 9), np.nan, np.float32), np.full(sample.shape[1], -1)
    count = four_point(points, sample, H, draw)
    assert np.isnan(H[count:]).all()
    return H[:count], draw[:count]


def alone(match: np.ndarray) -> np.ndarray:
    """The models of one sample, its matches (4, 4) in columns."""
    return solved(np.ascontiguousarray(match), np.arange(4)[:, None])[0]


def quadrilateral(seed: int, kind: str = "seen") -> np.ndarray:
    """Matches (4, 4) of a plane that is seen, or of nothing."""
    rng = np.random.default_rng(seed)
    x0 = rng.uniform(-1, 1, (4, 2))
    H = np.eye(3) + rng.uniform(-0.3, 0.3, (3, 3))
    x1 = reference.mapped(H.ravel(), x0) if kind == "seen" else rng.uniform(-1, 1, (4, 2))
    return np.ascontiguousarray(np.c_[x0, x1].T)


@pytest.mark.parametrize("kind", ["seen", "random"])
def test_samples_equal_the_dlt(kind: str) -> None:
    count = 300
    points = np.hstack([quadrilateral(seed, kind) for seed in range(count)])
    sample = np.arange(4 * count).reshape(count, 4).T.copy()
    H, draw = solved(points, sample)
    assert (np.diff(draw) > 0).all()
    expected = [reference.four_points(points[:, i]) for i in sample.T]
    assert draw.tolist() == [i for i, (h, _) in enumerate(expected) if h is not None]
    assert 10 < len(draw) < count or kind == "seen"
    for h, i in zip(H, draw, strict=True):
        truth, condition = expected[i]
        # A rounding to float32, and 64 in float64 (9 entries of 3 products, the equations' own) times the condition.
        np.testing.assert_allclose(h, truth, atol=ROUNDING32 + 64 * ROUNDING64 * condition)


@pytest.mark.parametrize("image", [0, 1])
@pytest.mark.parametrize("three", list(itertools.combinations(range(4), 3)))
def test_three_points_on_a_line_give_no_model(three: tuple[int, int, int], image: int) -> None:
    for seed in range(20):
        match, share = quadrilateral(seed), np.random.default_rng(seed).uniform(-2, 2)
        a, b, c = (match[2 * image : 2 * image + 2, k] for k in three)
        c[:] = a + share * (b - a)  # to rounding
        assert len(alone(match)) == 0


@pytest.mark.parametrize("image", [0, 1])
@pytest.mark.parametrize("two", list(itertools.combinations(range(4), 2)))
def test_coincident_points_give_no_model(two: tuple[int, int], image: int) -> None:
    match = quadrilateral(0)
    match[2 * image : 2 * image + 2, two[1]] = match[2 * image : 2 * image + 2, two[0]]
    assert len(alone(match)) == 0


def test_a_mirrored_plane_gives_no_model() -> None:
    for seed in range(20):
        match = quadrilateral(seed)
        assert len(alone(match)) == 1
        match[2] *= -1
        assert len(alone(match)) == 0


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_points_of_any_unit(scale: float) -> None:
    """Also which samples are degenerate does not depend on it."""
    for seed in range(20):
        match = quadrilateral(seed)
        h, D = reference.four_points(match)[0], np.diag([scale, scale, 1])
        expected = D @ h.reshape(3, 3) @ np.linalg.inv(D)
        (H,) = alone(match * scale)
        np.testing.assert_allclose(H, expected.ravel() / np.linalg.norm(expected), atol=2 * ROUNDING32)
        match[2:, 3] = (match[2:, 0] + 2 * match[2:, 1]) / 3
        assert len(alone(match * scale)) == 0
