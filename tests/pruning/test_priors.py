"""The soft form of the pruners: their evidence, its calibration, and the filter that makes it hard again."""

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch import Correspondences, presets
from fmtorch.pruning import GMS, LPM, Calibration, calibration, frame_agreement, gms_support, position_agreement
from fmtorch.pruning.consistency import CURVES, MIN_VOTE, NOISE, TOLERANCE, TURNS, WINDOW, WORST_RATIO
from tests.laws import scene
from tests.pruning.test_gms import SIZE0, SIZE1, moving, moving_along
from tests.reference import consistency as reference
from tests.reference import gms
from tests.variants import built

SCORED = Calibration(
    {"constant": -1.0, "evidence": 3.0, "ratio": -2.0}, {"constant": -2.0, "evidence": 4.0},
    {"constant": 1.5, "tolerance": 0.25},
)  # fmt: skip
PRIORS = {"frame_consistency": "x0 x1 lafs0", "position_consistency": "x0", "match_noise": "lafs0 prior"}


def logistic(z: torch.Tensor) -> torch.Tensor:
    return calibration.logistic(z.double().clamp(-12, 12)).to(z.dtype)


def test_logistic() -> None:
    z = torch.linspace(-30, 30, 2001, dtype=torch.float64)
    # (1 + z / n)^n is exp(z - z^2 / 2n + ...): the logarithm of the odds is off by z^2 / 2048, at the slope p (1 - p).
    bound = (z.square() / 2000 * torch.sigmoid(z) * torch.sigmoid(-z)).clamp_min(1e-5)
    assert ((logistic(z) - torch.sigmoid(z)).abs() <= bound).all()
    assert (logistic(z).diff() >= 0).all()


def test_calibration_uses_the_ratio_where_there_is_one() -> None:
    c = scene(0, 30).replace(prior=None)
    evidence = torch.rand(1, 30, generator=torch.Generator().manual_seed(0))
    both = Calibration({"constant": -1.0, "evidence": 3.0, "ratio": -2.0}, {"constant": -2.0, "evidence": 4.0})
    with_ratio, alone = both(c, evidence).prior, both(c.replace(ratio=None), evidence).prior
    assert torch.equal(with_ratio, logistic(-1 + 3 * evidence - 2 * c.ratio))
    assert torch.equal(alone, logistic(-2 + 4 * evidence))
    unknown = c.ratio.clone()
    unknown[0, 3] = torch.nan
    assert both(c.replace(ratio=unknown), evidence).prior[0, 3] == logistic(-3 + 3 * evidence[0, 3])
    assert Calibration(both.with_ratio)(c.replace(ratio=None), evidence).prior is None


def by_score(evidence: torch.Tensor, score: torch.Tensor) -> torch.Tensor:
    """P(inlier) of the matches of one pair, as the docstring of `Calibration` has it."""
    alone = torch.sigmoid(-2 + 4 * evidence.double())
    scored = torch.sigmoid(1.5 + 0.75 * torch.logit(score.double().clamp(1e-3, 1 - 1e-3)))
    correlation = torch.corrcoef(torch.stack([scored, alone]))[0, 1]  # NaN of equal scores
    return scored if (scored.mean() - alone.mean()).abs() < 0.25 and correlation > 0.1 else alone


def test_scores_are_taken_for_probabilities_only_where_they_are_like_the_agreement() -> None:
    generator = torch.Generator().manual_seed(0)
    evidence, mask = torch.rand(4, 40, generator=generator), torch.ones(4, 40, dtype=torch.bool)
    rows = (evidence[0] / 2).clamp(0.01), torch.linspace(0, 1, 40), evidence[2] / 100, torch.full((40,), 0.2)
    score, mask[1, 25:] = torch.stack(rows), False
    c = scene(0, 40).replace(prior=None, ratio=None)
    c = Correspondences(c.x0.expand(4, -1, -1), c.x1.expand(4, -1, -1), mask, score=torch.where(mask, score, torch.nan))
    expected = torch.stack([by_score(evidence[i], score[i]) for i in (0, 2, 3)])
    prior = SCORED(c, evidence).prior
    torch.testing.assert_close(prior[[0, 2, 3]], expected.float(), atol=0.005, rtol=0)  # of `logistic`
    torch.testing.assert_close(prior[1, :25], by_score(evidence[1, :25], score[1, :25]).float(), atol=0.005, rtol=0)
    assert torch.equal(prior[2:], logistic(-2 + 4 * evidence[2:])), "scores of another mean, or all equal, are ignored"
    assert not torch.allclose(prior[0], logistic(-2 + 4 * evidence[0]), atol=0.05)
    assert not prior[1, 25:].any()
    assert torch.equal(SCORED(c[1:2], evidence[1:2]).prior, prior[1:2]), "neighbours are invisible"
    with_ratio = logistic(-1 + 3 * evidence - 2 * evidence) * mask
    assert torch.equal(SCORED(c.replace(ratio=evidence), evidence).prior, with_ratio)


@pytest.mark.parametrize("share", [0.2, 1e-4])
def test_gradients_of_a_calibrated_score(share: float) -> None:
    c = scene(0, 12).replace(prior=None, ratio=None)
    evidence = torch.rand(1, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    score = (share * evidence.detach()).requires_grad_()
    wanted = score if share == 0.2 else evidence
    (slope,) = torch.autograd.grad(SCORED(c.replace(score=score), evidence).prior.sum(), wanted)
    (expected,) = torch.autograd.grad(by_score(evidence[0], score[0]).sum(), wanted)
    torch.testing.assert_close(slope, expected.to(slope), atol=0.01, rtol=0.02)


@pytest.mark.parametrize(("angle", "scale"), [(0.0, 1.0), (np.pi / 2, 0.5)])
def test_gms_support_equals_the_definition(angle: float, scale: float) -> None:
    x0, x1 = moving(0, 150, angle, scale)
    searched = angle != 0
    computed = gms_support(
        x0[None], x1[None], size0=torch.tensor([SIZE0]), size1=torch.tensor([SIZE1]),
        with_rotation=searched, with_scale=searched, threshold_factor=2.0,
    )[0]  # fmt: skip
    z = np.array(gms.support(x0.numpy(), x1.numpy(), (SIZE0, SIZE1), searched, 2.0))
    np.testing.assert_allclose(computed, z / (z + 1.5), rtol=1e-6)  # float64 rounded to float32


def test_priors_follow_the_right_matches_of_a_common_motion() -> None:
    x0, x1 = (x[None].float() for x in moving_along(0, 1000, outliers=0.5))
    turn = torch.tensor([[0.95, 0.2], [-0.2, 0.95]])
    right = (x1 - x0 @ turn - torch.tensor([30.0, 10.0])).norm(dim=-1)[0] < 3
    c = scene(0, 1000).replace(x0=x0, x1=x1, ratio=None, lafs0=None, lafs1=None, prior=None)
    for name in ("gms:soft=true", "lpm:soft=true", "position_consistency", "code:soft=true"):
        prior = built("pruner", name)(c).prior[0]
        area = (prior[right][:, None] > prior[~right][None]).double().mean()
        assert area > 0.9, name
        assert prior[right].median() > 0.5, name
        assert prior[~right].median() < 0.2, name


@pytest.mark.parametrize("name", ["gms", "lpm"])
def test_the_hard_form_leaves_the_prior_and_the_soft_form_the_matches(name: str) -> None:
    c = scene(6, 500)
    hard, soft = presets.build("pruner", name)(c), presets.build("pruner", name, soft=True)(c)
    assert torch.equal(hard.prior, c.prior)
    assert not torch.equal(hard.mask, c.mask)
    assert torch.equal(soft.mask, c.mask)
    assert not torch.equal(soft.prior, c.prior)


def test_likely_makes_a_filter_of_a_prior() -> None:
    c = presets.build("pruner", "frame_consistency")(scene(0, 200))
    kept = presets.build("pruner", "likely", min_probability=0.3)(c)
    assert torch.equal(kept.mask, c.prior >= 0.3)
    with pytest.raises(ValueError, match="prior"):
        presets.build("pruner", "likely")(c.replace(prior=None))


def test_a_stage_that_would_do_nothing_is_refused() -> None:
    for stage in (GMS, LPM):
        with pytest.raises(ValueError, match="calibration"):
            stage(soft=True)


@pytest.mark.parametrize("name", PRIORS)
def test_gradients_are_finite_beside_padding_and_what_is_no_frame(name: str) -> None:
    c = scene(2, 50)
    lafs0, mask = c.lafs0.clone(), c.mask.clone()
    lafs0[:, 3], lafs0[:, 4], mask[:, 5:9] = torch.nan, 0.0, False
    c = c.replace(lafs0=lafs0, mask=mask)
    fields = {field: getattr(c, field).clone().requires_grad_() for field in PRIORS[name].split()}
    pruned = presets.build("pruner", name)(c.replace(**fields))
    (pruned.noise if name == "match_noise" else pruned.prior).sum().backward()
    for value in fields.values():
        assert bool(torch.isfinite(value.grad).all())
        assert bool((value.grad != 0).any())


@pytest.mark.parametrize("given", [("ratio", "lafs0", "lafs1"), ("ratio",), ("score",), ()])
def test_find_fundamental_derives_the_prior(given: tuple[str, ...]) -> None:
    c, name = scene(2, 120), "frame_consistency" if "lafs0" in given else "position_consistency"
    c = c.replace(score=(1 - c.ratio).clamp(0.01, 0.99))
    fields = {field: getattr(c, field) for field in given}
    prior = presets.build("pruner", name)(Correspondences(c.x0, c.x1, c.mask, **fields)).prior
    own = fmtorch.find_fundamental(c.x0, c.x1, **fields)
    ranked = {key: value for key, value in fields.items() if key in ("ratio", "score")}
    assert torch.equal(own.F, fmtorch.find_fundamental(c.x0, c.x1, prior=prior, **ranked).F)


@pytest.mark.parametrize(("name", "area"), [("frame_consistency", 0.9), ("position_consistency", 0.88)])
def test_priors_tell_inliers_on_real_pairs(name, area, real_matches):
    """Area under the ROC curve; 0.95 over all pairs of this scene, where the ratio alone reaches 0.7 to 0.86."""
    areas = []
    for c, right in real_matches:
        prior = presets.build("pruner", name)(c).prior
        good, bad = prior[c.mask & right].numpy(), prior[c.mask & ~right].numpy()
        areas.append((good[:, None] > bad[None]).mean())
    assert np.mean(areas) > area


def test_without_frames_or_quality_the_prior_is_left_alone() -> None:
    pruner = presets.build("pruner", "frame_consistency")
    c = scene(2, 50)
    assert pruner(c.replace(lafs0=None)).prior is c.prior
    assert pruner(c.replace(ratio=None)).prior is c.prior


@pytest.mark.parametrize("frames", [True, False])
def test_gradients_are_those_of_the_definition(frames: bool) -> None:
    c, function = scene(2, 30), frame_agreement if frames else position_agreement
    names = ("x0", "x1", "ratio", *(("lafs0", "lafs1") if frames else ()))
    fields = {name: getattr(c, name).double().requires_grad_() for name in names}
    weight = torch.linspace(-1, 1, 30, dtype=torch.float64)

    def defined(x0: np.ndarray, x1: np.ndarray, ratio: np.ndarray, **lafs: np.ndarray) -> float:
        maps = reference.similarity(x0[0], x1[0], CURVES, TURNS, fmtorch.pruning.consistency.SCALES)
        if frames:
            maps = lafs["lafs1"][0, :, :, :2] @ np.linalg.inv(lafs["lafs0"][0, :, :, :2])
        vote = np.maximum(WORST_RATIO - ratio[0], MIN_VOTE)
        return float(weight.numpy() @ reference.agreement(x0[0], x1[0], maps, vote, CURVES, WINDOW, TOLERANCE, NOISE))

    (function(**fields, mask=c.mask)[0] * weight).sum().backward()
    rng, step = np.random.default_rng(0), 1e-5
    for name, tensor in fields.items():
        for place in rng.choice(tensor.numel(), 2, replace=False):
            values = []
            for change in (step, -step):
                arrays = {other: value.detach().numpy().copy() for other, value in fields.items()}
                arrays[name].reshape(-1)[place] += change
                values.append(defined(**arrays))
            slope = (values[0] - values[1]) / (2 * step)
            # Orders along curves are constants of both; central differences are of order 2.
            assert abs(float(tensor.grad.reshape(-1)[place]) - slope) < 1e-6 * max(1.0, abs(slope)), (name, place)
