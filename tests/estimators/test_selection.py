"""The choice among refined candidates."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.pairs import normalized_pairs
from fmtorch.estimators.saturated_gains import SaturatedGains
from fmtorch.estimators.scores import score_models
from tests.laws import scene


def test_saturation_prefers_what_explains_the_whole_image() -> None:
    """Of two models with as many inliers each, the one whose inliers lie in more cells scores higher."""
    c = scene(0, 40, outliers=0.0, noise=0.0)
    pairs = dataclasses.replace(normalized_pairs(c, 0, 8)[0][0], prior=None)
    spread = torch.linspace(-0.9, 0.9, 128, dtype=torch.float64)[None]
    crowd = torch.where(torch.arange(128) < 2, spread.sign() * 0.9, 0.5)  # two in the corners span the same grid
    crowd[0, 1] = 0.9
    vertical = torch.zeros(9, 1, 1, dtype=torch.float64)
    vertical[2], vertical[6] = -1, 1  # x1 - x0 = 0
    scores = []
    for px in (spread, crowd):
        points = torch.stack([px, px, px, px])
        crowded = dataclasses.replace(pairs, points=points)
        scores.append(float(score_models(SaturatedGains(1.0), vertical, crowded)))
    assert scores[0] > 2 * scores[1]


@pytest.mark.parametrize(("option", "value"), [("select", {"score": "best"}), ("refine", {"kernel": "l1"})])
def test_unknown_parts_are_told(option: str, value: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=next(iter(value.values()))):
        HypothesizeAndVerify(**{option: value})(scene(1, 100))  # type: ignore[arg-type]
