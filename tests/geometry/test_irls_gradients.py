"""Gradients of iteratively reweighted least squares: finite differences, degenerate scenes, the laws."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.core.types import Correspondences, collate
from fmtorch.geometry import eight_point, irls, reweighted_fits
from fmtorch.geometry.robust_losses import LOSSES
from tests import laws
from tests.geometry.scenes import unit_scene

SCALE = 0.02


def tolerances(loss: str) -> dict[str, float | bool]:
    """Of `gradcheck`, along random directions. Central differences round 1e-15 times the condition 1e3 over the step.

    The tabulated loss is linear between its entries, 1 / 1000 apart, whose slopes differ by as much.
    """
    return {
        "eps": 1e-6,
        "atol": 1e-5,
        "rtol": 1e-3 if loss == "magsac" else 1e-5,
        "fast_mode": True,
        "check_undefined_grad": False,
    }


def inputs(seed: int, n: int = 24, noise: float = 3e-3, outliers: int = 3) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points of both images, a first model and weights."""
    F, x0, x1 = (torch.from_numpy(v) for v in unit_scene(seed, n, noise, outliers))
    rng = np.random.default_rng(seed)
    near = F + 0.02 * torch.from_numpy(rng.normal(size=(3, 3)))
    return x0, x1, near, torch.from_numpy(rng.uniform(0.2, 1, n))


@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_are_those_of_the_fixed_point(loss: str) -> None:
    """Finite differences of the converged iteration."""
    x0, x1, F0, weight = inputs(2, outliers=1)
    converged = irls(x0, x1, F0, weight, loss=loss, scale=SCALE, iterations=60)

    def function(x0: Tensor, x1: Tensor, w: Tensor) -> Tensor:
        return irls(x0, x1, converged, w, loss=loss, scale=SCALE, iterations=15)

    attached = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    assert torch.autograd.gradcheck(function, attached, **tolerances(loss))


def test_models_of_a_pool_have_their_own_gradients() -> None:
    x0, x1, F0, weight = inputs(3)
    pool = torch.stack([F0, F0 + 0.01, -F0])
    w = weight.clone().requires_grad_()
    fitted = irls(x0, x1, pool, w, scale=SCALE)
    for i in range(3):
        alone = irls(x0, x1, pool[i], w, scale=SCALE)
        pooled, own = (torch.autograd.grad(F.square()[0].sum(), w, retain_graph=True)[0] for F in (fitted[i], alone))
        torch.testing.assert_close(pooled, own, rtol=1e-10, atol=1e-12)


def test_nothing_is_recorded_without_need() -> None:
    x0, x1, F0, weight = inputs(3)
    plain = irls(x0, x1, F0, weight, scale=SCALE)
    assert not plain.requires_grad
    attached = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    with torch.no_grad():
        assert not irls(*attached[:2], F0, attached[2], scale=SCALE).requires_grad
    first = F0.clone().requires_grad_()
    assert not irls(x0, x1, first, weight, scale=SCALE).requires_grad
    fitted = irls(*attached[:2], first, attached[2], scale=SCALE)
    assert fitted.requires_grad
    assert torch.equal(fitted, plain)


def degenerate() -> dict[str, Correspondences]:
    """Every pair that may not take its batch down, and more that only a gradient minds."""
    good = laws.scene(1)
    slots = torch.arange(good.mask.shape[1])[None]
    noisy = good.x0 * 1.1 + 3 + 0.3 * torch.randn(good.x0.shape, generator=torch.Generator().manual_seed(0))
    return {
        **laws.degenerate(),
        "eight matches": good.replace(mask=slots < 8),
        "no weight": good.replace(prior=good.prior * 0),
        "a weight that is NaN": good.replace(prior=torch.where(slots == 3, torch.nan, good.prior)),
        "masked NaN": good.replace(
            mask=slots < 80, x0=torch.where((slots < 80)[..., None], good.x0, torch.nan),
            prior=torch.where(slots < 80, good.prior, torch.nan),
        ),
        "a plane with noise": good.replace(x1=noisy),
        "very small": good.replace(x0=good.x0.double() * 1e-9, x1=good.x1.double() * 1e-9),
        "very large": good.replace(x0=good.x0.double() * 1e9, x1=good.x1.double() * 1e9),
    }  # fmt: skip


@functools.cache
def first_model() -> Tensor:
    clean = laws.scene(1, outliers=0.0)
    return eight_point(clean.x0.double(), clean.x1.double())[0][0]


@pytest.mark.parametrize("kind", degenerate())
def test_gradients_are_finite_and_do_not_touch_neighbours(kind: str) -> None:
    """A good pair beside a degenerate one has the bits it has alone, and the gradients up to rounding."""
    good, bad = laws.scene(1), degenerate()[kind]
    size = {"very small": 1e-9, "very large": 1e9}.get(kind, 1.0)
    shrink = torch.diag(torch.tensor([1 / size, 1 / size, 1.0], dtype=torch.float64))
    F0 = torch.stack([first_model(), shrink @ first_model() @ shrink, first_model()])
    pairs = [good.replace(x0=good.x0.double(), x1=good.x1.double()), bad, laws.scene(2)]
    c = collate([pair.replace(x0=pair.x0.double(), x1=pair.x1.double()) for pair in pairs])

    def fitted(c: Correspondences, F0: Tensor) -> tuple[Tensor, list[Tensor]]:
        assert c.prior is not None
        x0, x1, weight = attached = [v.double().clone().requires_grad_() for v in (c.x0, c.x1, c.prior)]
        scale = torch.tensor([2.0, 2.0 * size, 2.0], dtype=torch.float64)[: len(F0)]
        F = irls(x0, x1, F0, weight, c.mask, scale=scale)
        return F.detach(), list(torch.autograd.grad(F.sum(), attached))

    F, gradients = fitted(c, F0)
    assert bool(F.isfinite().all())
    for g in gradients:
        assert bool(g.isfinite().all())
        assert bool((g[~c.mask] == 0).all())
    alone, its_gradients = fitted(pairs[0], F0[:1])
    assert torch.equal(F[0], alone[0])
    n = good.mask.shape[1]
    for g, own in zip(gradients, its_gradients, strict=True):
        torch.testing.assert_close(g[0, :n], own[0], rtol=1e-8, atol=1e-10 * float(own.abs().max()))


def test_what_is_no_model_has_no_gradient() -> None:
    x0, x1, F0, weight = inputs(3)
    pool = torch.stack([F0, F0 * torch.nan])
    attached = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    fitted = irls(*attached[:2], pool, attached[2], scale=SCALE)
    alone = irls(*attached[:2], F0, attached[2], scale=SCALE)
    sums = [torch.autograd.grad(f.sum(), attached, retain_graph=True) for f in (fitted, alone)]
    for g, own in zip(*sums, strict=True):
        torch.testing.assert_close(g, own, rtol=1e-8, atol=1e-8 * float(own.abs().max()))


def test_padding_is_invisible_to_gradients() -> None:
    x0, x1, F0, weight = inputs(4)
    where = torch.arange(24) * 2 + 7
    padded = [torch.full((61, *v.shape[1:]), torch.nan, dtype=torch.float64) for v in (x0, x1, weight)]
    for long, short in zip(padded, (x0, x1, weight), strict=True):
        long[where] = short
    mask = torch.zeros(61, dtype=torch.bool)
    mask[where] = True
    results = []
    for a, b, w, m in ((x0, x1, weight, None), (*padded, mask)):
        attached = [v.clone().requires_grad_() for v in (a, b, w)]
        F = irls(*attached[:2], F0, attached[2], m, scale=SCALE)
        results.append((F.detach(), torch.autograd.grad(F[0].sum(), attached)))
    assert torch.equal(results[0][0], results[1][0])
    for short, long in zip(results[0][1], results[1][1], strict=True):
        torch.testing.assert_close(long[where], short, rtol=1e-10, atol=1e-12)
        assert bool((long[~mask] == 0).all())


def test_residuals_of_masked_slots_are_zero_and_no_matches_are_no_fit() -> None:
    x0, x1 = (torch.rand(1, 12, 2, generator=torch.Generator().manual_seed(i)) * 500 for i in (0, 1))
    mask = torch.arange(12)[None] < 10
    seen = []

    def weigh(F: torch.Tensor | None, residual: torch.Tensor | None) -> torch.Tensor:
        seen.append(residual)
        return mask.double()

    fits = reweighted_fits(x0, x1, weigh, 2, mask)
    assert bool(fits.valid.all())
    assert seen[1] is not None
    assert bool((seen[1][~mask] == 0).all())
    assert bool((seen[1][mask] > 0).all())
    none = reweighted_fits(x0[:, :0], x1[:, :0], lambda F, residual: torch.zeros(1, 0), 2)
    assert not bool(none.valid.any())
    assert bool((none.F == 0).all())
