"""The choice among refined candidates."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.choice import GRID, SaturatedGain
from fmtorch.estimators.problem import problems
from tests.laws import scene
from tests.reference import ransac as reference


def test_saturated_gain_equals_its_definition() -> None:
    problem = problems(scene(0, 70), 0, 8)[0][0]
    F = torch.randn(9, 1, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    F *= torch.logspace(-2, 0, 9, dtype=torch.float64)[:, None, None]
    threshold, unit = 3.0, float(problem.unit[0])
    batched = SaturatedGain(threshold).score(F, problem)[0]
    assert problem.prior is not None
    points, prior = problem.points[:, 0, :70].numpy(), problem.prior[0, :70].numpy()
    low, extent = points.min(1, keepdims=True), np.ptp(points, axis=1, keepdims=True)
    cell = np.clip((points - low) / extent * GRID, 0, GRID - 1).astype(int)
    for m in range(6):
        model = F[:, 0, m].numpy().reshape(3, 3)
        expected = 0.0
        for rows in ((0, 1), (2, 3)):
            cells: dict[tuple[int, int], float] = {}
            for n in range(70):
                r = unit * reference.sampson(model, points[:2, n], points[2:, n])
                where = (int(cell[rows[0], n]), int(cell[rows[1], n]))
                cells[where] = cells.get(where, 0.0) + prior[n] * max(0.0, 1 - (r / threshold) ** 2)
            expected += sum(math.sqrt(gain) for gain in cells.values())
        # Gains and roots are rounded to multiples of 2^-20; the root magnifies the first near zero to 2^-10.
        assert abs(float(batched[m]) - expected) < 140 * 2.0**-10


def test_saturation_prefers_what_explains_the_whole_image() -> None:
    """Of two models with as many inliers each, the one whose inliers lie in more cells scores higher."""
    c = scene(0, 40, outliers=0.0, noise=0.0)
    problem = dataclasses.replace(problems(c, 0, 8)[0][0], prior=None)
    spread = torch.linspace(-0.9, 0.9, 128, dtype=torch.float64)[None]
    crowd = torch.where(torch.arange(128) < 2, spread.sign() * 0.9, 0.5)  # two in the corners span the same grid
    crowd[0, 1] = 0.9
    vertical = torch.zeros(9, 1, 1, dtype=torch.float64)
    vertical[2], vertical[6] = -1, 1  # x1 - x0 = 0
    scores = []
    for px in (spread, crowd):
        points = torch.stack([px, px, px, px])
        scores.append(float(SaturatedGain(1.0).score(vertical, dataclasses.replace(problem, points=points))))
    assert scores[0] > 2 * scores[1]


@pytest.mark.parametrize(("option", "value"), [("choice", "best"), ("refine", "l1")])
def test_unknown_parts_are_told(option: str, value: str) -> None:
    with pytest.raises(ValueError, match=value):
        HypothesizeAndVerify(**{option: value})(scene(1, 100))  # type: ignore[arg-type]
