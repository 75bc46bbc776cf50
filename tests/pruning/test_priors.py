"""The soft form of the pruners: their evidence, its calibration, and the filter that makes it hard again."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.pruning import GMS, LPM, Calibration, gms, gms_support, lpm_cost
from fmtorch.pruning.calibration import logistic
from tests.laws import scene
from tests.pruning.test_gms import SIZE0, SIZE1
from tests.pruning.test_gms import moving as moving_on_grids
from tests.pruning.test_lpm import moving
from tests.reference.gms import SCALES, normalised, run, support
from tests.reference.lpm import passes
from tests.variants import built

SOFT = ("gms:soft=true", "lpm:soft=true", "code:soft=true", "ratio_prior", "position_consistency", "frame_consistency")


def test_logistic() -> None:
    z = torch.linspace(-30, 30, 2001, dtype=torch.float64)
    # (1 + z / n)^n is exp(z - z^2 / 2n + ...): the logarithm of the odds is off by z^2 / 2048, at the slope p (1 - p).
    bound = (z.square() / 2000 * torch.sigmoid(z) * torch.sigmoid(-z)).clamp_min(1e-5)
    assert ((logistic(z) - torch.sigmoid(z)).abs() <= bound).all()
    assert (logistic(z).diff() >= 0).all()


def test_calibration_uses_the_ratio_where_there_is_one() -> None:
    c = scene(0, 30).replace(prior=None)
    assert c.ratio is not None
    evidence = torch.rand(1, 30, generator=torch.Generator().manual_seed(0))
    both = Calibration({"constant": -1.0, "evidence": 3.0, "ratio": -2.0}, {"constant": -2.0, "evidence": 4.0})
    with_ratio, alone = both(c, evidence).prior, both(c.replace(ratio=None), evidence).prior
    assert torch.equal(with_ratio, logistic(-1 + 3 * evidence - 2 * c.ratio))
    assert torch.equal(alone, logistic(-2 + 4 * evidence))
    unknown = c.ratio.clone()
    unknown[0, 3] = torch.nan
    assert both(c.replace(ratio=unknown), evidence).prior[0, 3] == logistic(-3 + 3 * evidence[0, 3])
    assert Calibration(both.with_ratio)(c.replace(ratio=None), evidence).prior is None


@pytest.mark.parametrize(("angle", "scale"), [(0.0, 1.0), (np.pi / 2, 0.5)])
def test_gms_support_equals_the_definition(angle: float, scale: float) -> None:
    x0, x1 = moving_on_grids(0, 400, angle, scale)
    searched = angle != 0
    computed = gms_support(
        x0[None], x1[None], size0=torch.tensor([SIZE0]), size1=torch.tensor([SIZE1]),
        with_rotation=searched, with_scale=searched, threshold_factor=2.0,
    )[0]  # fmt: skip
    p0, p1 = normalised(x0.numpy(), SIZE0), normalised(x1.numpy(), SIZE1)
    hypotheses = list(itertools.product(SCALES, range(8))) if searched else [(1.0, 0)]
    winner = max(hypotheses, key=lambda h: run(p0, p1, *h, 2.0, False).sum())  # the first of equals
    z = np.array(support(x0.numpy(), x1.numpy(), SIZE0, SIZE1, *winner))
    np.testing.assert_allclose(computed, z / (z + 1.5), rtol=1e-6)  # float64 rounded to float32


def test_gms_support_separates_what_gms_keeps() -> None:
    x0, x1 = (x[None] for x in moving_on_grids(3, 1500))
    sizes = {"size0": torch.tensor([SIZE0]), "size1": torch.tensor([SIZE1])}
    kept, support_of = gms(x0, x1, threshold_factor=4.0, **sizes), gms_support(x0, x1, **sizes)
    assert support_of[kept].median() > 2 * support_of[~kept].median()


@pytest.mark.parametrize("n", [0, 1, 9, 40, 160])
def test_lpm_cost_equals_the_definition(n: int) -> None:
    x0, x1 = moving(n, n)
    expected = np.mean(passes(x0.numpy(), x1.numpy())[1], axis=0)
    np.testing.assert_allclose(lpm_cost(x0[None], x1[None])[0], expected, rtol=1e-12)


@pytest.mark.parametrize("name", SOFT)
def test_soft_stages_keep_every_match_and_tell_right_from_wrong(name: str) -> None:
    c = scene(5, 600).replace(prior=None)
    n = c.mask.shape[1]
    mask = torch.arange(n)[None] % 7 != 0
    soft = built("pruner", name)(c.replace(mask=mask))
    assert torch.equal(soft.mask, mask)
    assert ((soft.prior >= 0) & (soft.prior <= 1)).all()
    assert not soft.prior[~mask].any()
    if name not in ("code:soft=true", "frame_consistency"):  # the scene's frames are random, and tell nothing
        assert 0.05 < float(soft.prior[mask].mean()) < 0.95


def test_priors_follow_the_right_matches_of_a_common_motion() -> None:
    x0, x1 = (x[None].float() for x in moving(0, 1000, outliers=0.5))
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
