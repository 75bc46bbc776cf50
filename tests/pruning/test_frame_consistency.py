"""Frame consistency: equal to its definition, one for a common motion, and telling on real pairs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch import presets
from fmtorch.core.types import Correspondences
from fmtorch.pruning import frame_agreement
from fmtorch.pruning.consistency import CURVES, MIN_VOTE, NOISE, TOLERANCE, WINDOW, WORST_RATIO
from tests.laws import scene
from tests.pruning.gradients import expect_gradients
from tests.reference import frame_consistency as reference


def common_motion(count: int = 80) -> Correspondences:
    """Matches that all obey one affine map, in position and in frame."""
    c = scene(0, count)
    A = torch.tensor([[1.2, -0.4], [0.3, 0.9]])
    assert c.lafs0 is not None
    x1 = c.x0 @ A.T + torch.tensor([20.0, -5.0])
    lafs1 = torch.cat([A @ c.lafs0[..., :2], x1[..., None]], -1)
    return c.replace(x1=x1, lafs1=lafs1)


def agree(c: Correspondences) -> torch.Tensor:
    assert c.lafs0 is not None
    assert c.lafs1 is not None
    return frame_agreement(c.x0, c.x1, c.lafs0, c.lafs1, c.ratio, c.mask)


@pytest.mark.parametrize("count", [2, 5, 60])
def test_equals_the_definition(count: int) -> None:
    c = scene(1, count)
    assert c.lafs0 is not None
    assert c.lafs1 is not None
    assert c.ratio is not None
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


def test_gradients_are_finite_beside_padding_and_what_is_no_frame() -> None:
    c = scene(2, 50)
    assert c.lafs0 is not None
    lafs = c.lafs0.clone()
    lafs[:, 3], lafs[:, 4] = float("nan"), 0.0
    mask = c.mask.clone()
    mask[:, 5:9] = False
    fields = {"x0": c.x0.clone(), "x1": c.x1.clone(), "lafs0": lafs}
    prior = presets.build("pruner", "frame_consistency")(
        c.replace(mask=mask, **{name: value.requires_grad_() for name, value in fields.items()})
    ).prior
    prior.sum().backward()
    for x in fields.values():
        assert x.grad is not None
        assert bool(torch.isfinite(x.grad).all())
        assert bool((x.grad != 0).any())


def test_without_frames_or_quality_the_prior_is_left_alone() -> None:
    pruner = presets.build("pruner", "frame_consistency")
    c = scene(2, 50)
    assert pruner(c.replace(lafs0=None)).prior is c.prior
    assert pruner(c.replace(ratio=None)).prior is c.prior


def test_find_fundamental_derives_the_prior_from_the_frames() -> None:
    c = scene(2, 120)
    given = presets.build("pruner", "frame_consistency")(c.replace(prior=None)).prior
    own = fmtorch.find_fundamental(c.x0, c.x1, ratio=c.ratio, lafs0=c.lafs0, lafs1=c.lafs1)
    with_prior = fmtorch.find_fundamental(c.x0, c.x1, ratio=c.ratio, prior=given)
    assert torch.equal(own.F, with_prior.F)


def test_tells_inliers_on_real_pairs(real_matches: list[tuple[Correspondences, Tensor]]) -> None:
    areas = []
    for c, right in real_matches:
        prior = presets.build("pruner", "frame_consistency")(c).prior
        assert prior is not None
        good, bad = prior[c.mask & right].numpy(), prior[c.mask & ~right].numpy()
        areas.append((good[:, None] > bad[None]).mean())
    # Area under the ROC curve; 0.95 over all pairs of this scene, where the ratio alone reaches 0.7 to 0.86.
    assert np.mean(areas) > 0.9
