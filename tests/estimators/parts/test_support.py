"""Inliers that determine no model: at too few places, or on one line in an image."""

from __future__ import annotations

import numpy as np
import pytest

from fmtorch.estimators.pair import Pair
from fmtorch.estimators.parts.support import degenerate_support


def pair_of_points(points: np.ndarray) -> Pair:
    """A pair of points (4, n) in normalised units, as they are."""
    n = points.shape[1]
    table = np.vstack([points, np.ones((5, n))])
    return Pair(table, (False, False, False), 128, 1.0, 1, 0, np.zeros(4), np.empty(0))


@pytest.mark.parametrize("rounding", [2.0**-24, 2.0**-53])
@pytest.mark.parametrize("shift", [0.0, 3000.0])
def test_points_of_a_line_and_points_near_one(rounding: float, shift: float) -> None:
    rng = np.random.default_rng(0)
    dtype = np.float32 if rounding > 1e-9 else np.float64
    for seed in range(20):
        direction, start = rng.normal(size=2), rng.uniform(0, 500, 2) + shift
        line = start + rng.uniform(-300, 300, (30, 1)) * direction / np.linalg.norm(direction)
        near = line + rng.normal(0, 0.02, (30, 2))  # px: no detector is as exact
        other = rng.uniform(0, 500, (30, 2))
        for x0, x1, where in (
            (line, other, "image 0"),
            (other, line, "image 1"),
            (line, line[::-1], "image 0 and image 1"),
            (near, other, ""),
        ):
            points = np.hstack([x0, x1]).astype(dtype).astype(np.float64).T.copy()
            exact = rounding * 2 * np.abs(points).max()  # coordinates are rounded to half a unit in the last place
            reason = degenerate_support(pair_of_points(points), np.ones(30, np.bool_), 7, exact)
            assert reason == (f"the inliers of the best model lie on one line in {where}" if where else ""), seed


def test_inliers_count_once_at_one_place_and_late_ones_are_seen() -> None:
    points = np.random.default_rng(1).uniform(0, 500, (4, 1000))
    inliers = np.zeros(1000, np.bool_)
    inliers[[3, 900, 901, 902, 903, 904, 999]] = True
    assert degenerate_support(pair_of_points(points), inliers, 7, 0.0) == ""
    assert "has 7 different inliers; at least 8" in degenerate_support(pair_of_points(points), inliers, 8, 0.0)
    points[:, 306:320] = points[:, 305:306]
    inliers[:] = False
    inliers[300:320] = True  # at six places
    assert "has 6 different inliers; at least 7" in degenerate_support(pair_of_points(points), inliers, 7, 0.0)
    assert "has 0 different inliers" in degenerate_support(pair_of_points(points), inliers & False, 7, 0.0)
