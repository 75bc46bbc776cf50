"""Consistency of frames and of positions equals its definition."""

import math

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.core import Correspondences
from fmtorch.pruning import frame_agreement, position_agreement
from fmtorch.pruning.consistency import CURVES, MIN_VOTE, NOISE, SCALES, TOLERANCE, TURNS, WINDOW, WORST_RATIO
from tests.laws import scene
from tests.pruning.gradients import expect_gradients
from tests.reference import consistency as reference


def common_motion(count: int = 80) -> Correspondences:
    """Matches that all obey one affine map, in position and in frame."""
    c = scene(0, count)
    A = torch.tensor([[1.2, -0.4], [0.3, 0.9]])
    x1 = c.x0 @ A.T + torch.tensor([20.0, -5.0])
    lafs1 = torch.cat([A @ c.lafs0[..., :2], x1[..., None]], -1)
    return c.replace(x1=x1, lafs1=lafs1)


def agree(c: Correspondences) -> torch.Tensor:
    return frame_agreement(c.x0, c.x1, c.lafs0, c.lafs1, c.ratio, c.mask)


@pytest.mark.parametrize("count", [2, 5, 60])
def test_equals_the_definition(count: int) -> None:
    c = scene(1, count)
    A0, A1 = c.lafs0[0, :, :, :2].double().numpy(), c.lafs1[0, :, :, :2].double().numpy()
    vote = np.maximum(WORST_RATIO - c.ratio[0].double().numpy(), MIN_VOTE)
    expected = reference.agreement(
        c.x0[0].double().numpy(),
        c.x1[0].double().numpy(),
        A1 @ np.linalg.inv(A0),
        vote,
        CURVES,
        WINDOW,
        TOLERANCE,
        NOISE,
    )
    # float32 throughout: a few hundred roundings, amplified by the condition of the frames
    np.testing.assert_allclose(agree(c)[0].numpy(), expected, rtol=1e-3, atol=1e-5)


def test_a_common_motion_agrees_wholly() -> None:
    # The prediction error is rounding alone: 1e-7 of coordinates of 1e3 px against lengths of at least 4 px.
    assert float((1 - agree(common_motion())).abs().max()) < 1e-5


def test_a_wrong_match_disagrees_and_is_told_from_the_right_ones() -> None:
    c = common_motion()
    x1 = c.x1.clone()
    x1[0, 7] += 300
    w = agree(c.replace(x1=x1))[0]
    assert float(w[7]) < 0.2
    assert float(w[torch.arange(len(w)) != 7].min()) > 0.8


def test_gradients_are_those_of_the_definition() -> None:
    c = scene(2, 30)
    fields = {name: getattr(c, name).double().requires_grad_() for name in ("x0", "x1", "lafs0", "lafs1", "ratio")}
    weight = torch.linspace(-1, 1, 30, dtype=torch.float64)

    def defined(x0: np.ndarray, x1: np.ndarray, lafs0: np.ndarray, lafs1: np.ndarray, ratio: np.ndarray) -> float:
        S, vote = lafs1[0, :, :, :2] @ np.linalg.inv(lafs0[0, :, :, :2]), np.maximum(WORST_RATIO - ratio[0], MIN_VOTE)
        agreement = reference.agreement(x0[0], x1[0], S, vote, CURVES, WINDOW, TOLERANCE, NOISE)
        return float(weight.numpy() @ agreement)

    (frame_agreement(**fields, mask=c.mask)[0] * weight).sum().backward()
    expect_gradients(fields, defined)


def test_without_frames_or_quality_the_prior_is_left_alone() -> None:
    pruner = presets.build("pruner", "frame_consistency")
    c = scene(2, 50)
    assert pruner(c.replace(lafs0=None)).prior is c.prior
    assert pruner(c.replace(ratio=None)).prior is c.prior


def agree_in_position(c: Correspondences) -> torch.Tensor:
    return position_agreement(c.x0, c.x1, c.ratio, c.mask)


def turned(c: Correspondences, angle: float, scale: float) -> Correspondences:
    """The same matches where image 1 is turned and zoomed."""
    R = scale * torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return c.replace(x1=c.x1 @ R.T)


@pytest.mark.parametrize("ratios", [True, False])
@pytest.mark.parametrize(("angle", "scale"), [(0.0, 1.0), (2.0, 0.6)])
@pytest.mark.parametrize("count", [1, 2, 5, 60])
def test_positions_equal_the_definition(count: int, angle: float, scale: float, ratios: bool) -> None:
    c = turned(scene(1, count), angle, scale)
    c = c if ratios else c.replace(ratio=None)
    x0, x1 = c.x0[0].double().numpy(), c.x1[0].double().numpy()
    S = reference.similarity(x0, x1, CURVES, TURNS, SCALES)
    vote = np.ones(count) if c.ratio is None else np.maximum(WORST_RATIO - c.ratio[0].double().numpy(), MIN_VOTE)
    expected = reference.agreement_of_positions(x0, x1, S, vote, CURVES, WINDOW, TOLERANCE, NOISE)
    # float32: coordinates of 1e3 px are rounded to 6e-5 px, against lengths of at least 4 px
    np.testing.assert_allclose(agree_in_position(c)[0].numpy(), expected, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(("angle", "scale"), [(0.0, 1.0), (math.pi / 2, 1.0), (-2.5, 2.3), (0.3, 0.4)])
def test_a_common_motion_agrees_and_a_wrong_match_does_not(angle: float, scale: float) -> None:
    c = scene(0, 80)
    c = turned(c.replace(x1=c.x0), angle, scale)
    # Off the nearest hypothesis by at most pi / 16 and 2^(1/4): e is at most half the difference of the two maps.
    worst = abs(2**0.25 * np.exp(1j * math.pi / 16) - 1) / (1 + 2**0.25)
    assert float(agree_in_position(c).min()) > (1 + (worst / TOLERANCE) ** 2 / 8) ** -8
    x1 = c.x1.clone()
    x1[0, 7] += 700 * scale
    assert float(agree_in_position(c.replace(x1=x1))[0, 7]) < 0.1


def test_gradients_of_positions_are_those_of_the_definition() -> None:
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
