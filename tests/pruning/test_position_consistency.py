"""Position consistency: equal to its definition, blind to rotation and zoom, and telling on real pairs."""

import math

import numpy as np
import pytest
import torch

from fmtorch.core import Correspondences
from fmtorch.pruning import position_agreement
from fmtorch.pruning.consistency import CURVES, MIN_VOTE, NOISE, SCALES, TOLERANCE, TURNS, WINDOW, WORST_RATIO
from tests.laws import scene
from tests.pruning.gradients import expect_gradients
from tests.reference import consistency as reference


def agree(c: Correspondences) -> torch.Tensor:
    return position_agreement(c.x0, c.x1, c.ratio, c.mask)


def turned(c: Correspondences, angle: float, scale: float) -> Correspondences:
    """The same matches where image 1 is turned and zoomed."""
    R = scale * torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return c.replace(x1=c.x1 @ R.T)


@pytest.mark.parametrize("ratios", [True, False])
@pytest.mark.parametrize(("angle", "scale"), [(0.0, 1.0), (2.0, 0.6)])
@pytest.mark.parametrize("count", [1, 2, 5, 60])
def test_equals_the_definition(count: int, angle: float, scale: float, ratios: bool) -> None:
    c = turned(scene(1, count), angle, scale)
    c = c if ratios else c.replace(ratio=None)
    x0, x1 = c.x0[0].double().numpy(), c.x1[0].double().numpy()
    S = reference.similarity(x0, x1, CURVES, TURNS, SCALES)
    vote = np.ones(count) if c.ratio is None else np.maximum(WORST_RATIO - c.ratio[0].double().numpy(), MIN_VOTE)
    expected = reference.agreement_of_positions(x0, x1, S, vote, CURVES, WINDOW, TOLERANCE, NOISE)
    # float32: coordinates of 1e3 px are rounded to 6e-5 px, against lengths of at least 4 px
    np.testing.assert_allclose(agree(c)[0].numpy(), expected, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(("angle", "scale"), [(0.0, 1.0), (math.pi / 2, 1.0), (-2.5, 2.3), (0.3, 0.4)])
def test_a_common_motion_agrees_and_a_wrong_match_does_not(angle: float, scale: float) -> None:
    c = scene(0, 80)
    c = turned(c.replace(x1=c.x0), angle, scale)
    # Off the nearest hypothesis by at most pi / 16 and 2^(1/4): e is at most half the difference of the two maps.
    worst = abs(2**0.25 * np.exp(1j * math.pi / 16) - 1) / (1 + 2**0.25)
    assert float(agree(c).min()) > (1 + (worst / TOLERANCE) ** 2 / 8) ** -8
    x1 = c.x1.clone()
    x1[0, 7] += 700 * scale
    assert float(agree(c.replace(x1=x1))[0, 7]) < 0.1


def test_gradients_are_those_of_the_definition() -> None:
    c = scene(2, 30)
    assert c.ratio is not None
    fields = {name: getattr(c, name).double().requires_grad_() for name in ("x0", "x1", "ratio")}
    weight = torch.linspace(-1, 1, 30, dtype=torch.float64)

    def defined(x0: np.ndarray, x1: np.ndarray, ratio: np.ndarray) -> float:
        S = reference.similarity(x0[0], x1[0], CURVES, TURNS, SCALES)
        vote = np.maximum(WORST_RATIO - ratio[0], MIN_VOTE)
        agreement = reference.agreement_of_positions(x0[0], x1[0], S, vote, CURVES, WINDOW, TOLERANCE, NOISE)
        return float(weight.numpy() @ agreement)

    (position_agreement(**fields, mask=c.mask)[0] * weight).sum().backward()
    expect_gradients(fields, defined)
