"""The least-squares fits of the presets: weighted by the prior, with gradients to it, or all inliers alike."""

import functools

import pytest
import torch
from torch import Tensor

from fmtorch import presets
from fmtorch.core import Correspondences, collate
from tests.laws import quick, scene, scenes
from tests.variants import OTHER_LIBRARIES


@functools.cache
def names(final: str) -> list[str]:
    """The presets whose estimate comes from this fit."""
    own = [n for n in presets.available("estimator") if not n.startswith(OTHER_LIBRARIES)]
    configs = {n: presets.load("estimator", n) for n in own}
    return [n for n, config in configs.items() if config.get("fine", config).get("final") == final]


def attached_to_prior(c: Correspondences) -> tuple[Correspondences, Tensor]:
    prior = c.prior.double().requires_grad_()
    return c.replace(x0=c.x0.double(), x1=c.x1.double(), prior=prior), prior


def test_which_presets_are_weighted() -> None:
    """Those of the paper are not, whatever a pruner before them supplies."""
    weighted, unweighted = names("least_squares"), names("unweighted_least_squares")
    assert {"ransac", "msac", "lmeds", "cf_ransac", "cf_ransac_usac"} <= set(weighted)
    assert not any(n.startswith("paper/") for n in weighted)
    assert {f"paper/{name}" for name in ("ransac", "msac", "lmeds", "cf_ransac", "gc_ransac")} <= set(unweighted)


@pytest.mark.parametrize("name", names("least_squares"))
def test_gradients_reach_the_prior(name: str) -> None:
    """Those of the finite differences: the search does not see the prior, so the inliers stay the same."""
    estimator = quick(name)
    c, prior = attached_to_prior(collate([scene(1), scene(2, 90)]))
    direction = torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def value(prior: Tensor) -> Tensor:
        return (estimator(c.replace(prior=prior), seed=5).F.double() * direction).sum((1, 2))

    loss = value(prior)
    (gradient,) = torch.autograd.grad(loss.sum(), prior)
    assert bool((gradient != 0).any(1).all())
    assert bool((gradient[~c.mask] == 0).all())
    move = torch.randn(prior.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    inside = (prior.detach() > 0.01) & (prior.detach() < 0.99)
    move, h = torch.where(inside, move, 0), 1e-5
    ends = [value((prior + sign * h * move).detach()) for sign in (-1, 1)]
    difference = (ends[1] - ends[0]) / (2 * h)
    # Of estimates of unit norm, rounded to 1e-12 by the condition of the scenes, with third derivatives of order 1e3.
    torch.testing.assert_close((gradient * move).sum(1), difference, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", names("least_squares"))
def test_a_constant_prior_is_as_good_as_none(name: str) -> None:
    c = scenes()
    estimator = quick(name)
    without = estimator(c.replace(prior=None), seed=5)
    assert torch.equal(estimator(c.replace(prior=torch.full_like(c.prior, 0.5)), seed=5).F, without.F)
    assert not torch.equal(estimator(c, seed=5).F, without.F)
    # Where the prior leaves no eight inliers, the hypothesis itself is the estimate.
    assert bool(estimator(c.replace(prior=torch.zeros_like(c.prior)), seed=5).F.isfinite().all())


@pytest.mark.parametrize("name", names("unweighted_least_squares"))
def test_the_paper_s_presets_ignore_the_prior(name: str) -> None:
    c, _ = attached_to_prior(scenes())
    estimator = quick(name)
    F = estimator(c, seed=5).F
    assert torch.equal(F, estimator(c.replace(prior=None), seed=5).F)
    assert not F.requires_grad
