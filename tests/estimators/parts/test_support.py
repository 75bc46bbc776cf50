"""Whether inliers could determine a model: enough different ones, and not all on one line."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmtorch.core.types import Correspondences
from fmtorch.estimators.preselection import FIRST_LOOK, degenerate_support
from tests.estimators.pairs import FEW, SCALES, named, pair_of
from tests.reference import support as reference

EPS32 = 2.0**-23


def reason_of(x0: np.ndarray, x1: np.ndarray, inliers: np.ndarray | None = None, dtype: type = np.float64) -> str:
    """What is said of a pair of these matches."""
    points = [torch.from_numpy(x.astype(dtype).astype(np.float64))[None] for x in (x0, x1)]
    pair = pair_of(Correspondences(*points, torch.ones(1, len(x0), dtype=torch.bool)))
    inside = np.ones(len(x0), np.bool_) if inliers is None else inliers
    return degenerate_support(pair, inside, 7, float(np.finfo(dtype).eps))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shift", [0.0, 3000.0])
@pytest.mark.parametrize("scale", SCALES)
def test_points_of_a_line_are_told_from_points_near_one(scale: float, shift: float, dtype: type) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        direction, start = rng.normal(size=2), rng.uniform(0, 500, 2) + shift
        line = start + rng.uniform(-300, 300, (30, 1)) * direction / np.linalg.norm(direction)
        near = line + rng.normal(0, 0.02, (30, 2))  # px: no detector is as exact
        other = rng.uniform(0, 500, (30, 2))
        for x0, x1, images in (
            (line, other, "image 0"),
            (other, line, "image 1"),
            (line, line[::-1], "image 0 and image 1"),
            (near, other, ""),
        ):
            expected = f"the inliers of the best model lie on one line in {images}" if images else ""
            assert reason_of(scale * x0, scale * x1, dtype=dtype) == expected


@pytest.mark.parametrize("count", [0, 6, 7])
def test_inliers_count_once_at_one_place_and_late_ones_are_seen(count: int) -> None:
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 500, (1000, 4))
    few = f"the best model has {count} different inliers; at least 7 are needed" if count < 7 else ""
    for first in (0, 100, FIRST_LOOK - 3, 900):
        inliers = np.zeros(1000, np.bool_)
        inliers[first : first + count] = True
        assert reason_of(x[:, :2], x[:, 2:], inliers) == few
        y = x.copy()
        y[first + count : first + count + 20] = x[first + max(count - 1, 0)]
        inliers[first + count : first + count + 20] = count > 0
        assert reason_of(y[:, :2], y[:, 2:], inliers) == few


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", ["scene 40", "scene 700", "real 7", *FEW])
def test_what_is_said_is_what_the_definition_says(name: str, scale: float) -> None:
    pair, rng = named(name, scale), np.random.default_rng(0)
    for share in (0.01, 0.1, 0.5, 1.0):
        inliers = rng.random(pair.count) < share
        reason = degenerate_support(pair, inliers, 7, EPS32)
        inside = pair.points[:, inliers].T
        largest = np.abs(pair.centre).max() / pair.pixels_per_unit + 1
        assert reason == reference.degenerate_support(inside, 7, EPS32 * largest)


def test_lines_up_to_the_rounding_of_float32_coordinates() -> None:
    """Points off a line by less than that of their extent are on it, whatever their type; by more of it not."""
    rng = np.random.default_rng(0)
    along = np.append(rng.uniform(-300, 300, 28), [-300, 300])
    other = rng.uniform(0, 500, (30, 2))
    for off, on_line in ((EPS32 / 16, True), (4 * EPS32, False)):  # of 600; the first point is as near as 300
        line = np.stack([along, 600 * off * rng.choice([-1, 1], 30)], 1)
        assert ("line in image 0" in reason_of(line, other)) == on_line
