"""Frame consistency: equal to its definition, one for a common motion, and telling on real pairs."""

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.core import Correspondences
from fmtorch.pruning import frame_agreement
from fmtorch.pruning.consistency import CURVES, MIN_VOTE, NOISE, TOLERANCE, WINDOW, WORST_RATIO
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
