"""The M-estimators reach the optimum, differentiate as it does, and use what is known of the matches."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.core.types import collate
from fmtorch.estimators import IterativelyReweighted
from fmtorch.geometry import KERNELS
from fmtorch.geometry.refine import refine
from tests.laws import scene, scenes
from tests.reference import refine as reference


@pytest.mark.parametrize("kernel", KERNELS)
def test_presets_name_their_kernel(kernel: str) -> None:
    estimator = presets.build("estimator", f"irls_{kernel}")
    assert isinstance(estimator, IterativelyReweighted)
    assert estimator.kernel == kernel


@pytest.mark.parametrize("kernel", KERNELS)
def test_is_a_minimum_of_the_weighted_loss(kernel: str) -> None:
    c = collate([scene(i, 150, outliers=0.05) for i in range(3)])
    estimate = IterativelyReweighted(kernel=kernel, threshold=2.0, refine_iterations=60)(c)
    assert bool(estimate.ok.all())
    assert bool((estimate.draws == 0).all())
    prior = c.prior
    assert prior is not None

    def cost(F: torch.Tensor, i: int) -> float:
        r2 = reference.sampson(F.numpy(), c.x0[i].double().numpy(), c.x1[i].double().numpy()) ** 2
        return float((prior[i].double().numpy() * reference.loss(r2, 4.0, kernel)).sum())

    further = refine(estimate.F, c.x0, c.x1, prior, c.mask, kernel=kernel, scale=2.0, iterations=50)
    for i in range(3):
        # The estimate took one more step, by Gauss and Newton's approximation, so a little may be left.
        assert cost(estimate.F[i], i) <= cost(further[i], i) * (1 + 1e-5)


def test_an_annealed_kernel_is_not_caught_where_a_narrow_one_is() -> None:
    pairs = collate([scene(i, 150, outliers=0.3) for i in range(40)]).replace(prior=None, quality=None)
    near = []
    for options in ({}, {"start_scale": 1e-9}):
        estimate = IterativelyReweighted(kernel="truncated", threshold=1.0, **options)(pairs)
        near.append(estimate.inliers.sum(1).to(torch.float64).mean())
    assert near[0] > 1.3 * near[1]


def test_the_prior_and_the_quality_decide_where_there_are_more_outliers_than_inliers() -> None:
    pairs = collate([scene(i, 150, outliers=0.65) for i in range(16)])
    inliers = {
        name: int(IterativelyReweighted(kernel="geman_mcclure", threshold=1.0)(c).inliers.sum())
        for name, c in {
            "prior": pairs,
            "quality": pairs.replace(prior=None),
            "nothing": pairs.replace(prior=None, quality=None),
        }.items()
    }
    assert inliers["prior"] > 1.2 * inliers["nothing"]
    assert inliers["quality"] > 1.2 * inliers["nothing"]


def test_gradients_reach_points_and_prior_and_are_those_of_the_optimum() -> None:
    c = collate([scene(i, 60, outliers=0.0, noise=0.05) for i in range(2)])
    prior = torch.where(c.mask, 0.7, 0).double().requires_grad_()
    x0, x1 = (x.double().requires_grad_() for x in (c.x0, c.x1))
    estimator = IterativelyReweighted(kernel="cauchy", threshold=2.0, refine_iterations=30)
    direction = torch.randn(2, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def value(x0: torch.Tensor, x1: torch.Tensor, prior: torch.Tensor) -> torch.Tensor:
        return (estimator(c.replace(x0=x0, x1=x1, prior=prior)).F * direction).sum()

    gradients = torch.autograd.grad(value(x0, x1, prior), (x0, x1, prior))
    generator = torch.Generator().manual_seed(1)
    for i, variable in enumerate((x0, x1, prior)):
        assert bool(torch.isfinite(gradients[i]).all())
        step = torch.randn(variable.shape, dtype=torch.float64, generator=generator) * c.mask.reshape(
            *c.mask.shape, *[1] * (variable.dim() - 2)
        )
        h = 1e-3
        moved = [
            value(*(v + sign * h * step if v is variable else v for v in (x0, x1, prior))).item() for sign in (1, -1)
        ]
        numeric, analytic = (moved[0] - moved[1]) / (2 * h), float((gradients[i] * step).sum())
        # Gauss and Newton's approximation leaves out the residuals' curvature, of the order of noise over image size.
        assert analytic == pytest.approx(numeric, rel=0.02, abs=1e-9)


def test_gradients_stay_finite_for_degenerate_pairs() -> None:
    c = scenes()
    x0 = c.x0.double().clone()
    x0[1] = 100.0
    x0 = x0.requires_grad_()
    estimate = presets.build("estimator", "irls_truncated")(c.replace(x0=x0, x1=c.x1.double()))
    estimate.F.square()[:, 0, 1].sum().backward()
    assert x0.grad is not None
    assert bool(torch.isfinite(x0.grad).all())
    assert not bool(estimate.ok[1])


@pytest.mark.parametrize(
    ("options", "message"),
    [({"kernel": "tukey"}, "kernel is 'tukey'"), ({"threshold": 0.0}, "must be positive"),
     ({"starts": []}, "list of integers"), ({"starts": [1, -1]}, "list of integers")],
)  # fmt: skip
def test_bad_options_are_told(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        IterativelyReweighted(**{"kernel": "huber", "threshold": 1.0, **options})  # type: ignore[arg-type]


def test_too_few_matches_have_a_reason() -> None:
    estimate = IterativelyReweighted(kernel="huber", threshold=1.0)(scene(0, 7))
    assert estimate.reason == ("7 matches; at least 8 are needed",)
    assert np.all(estimate.F.numpy() == 0)
