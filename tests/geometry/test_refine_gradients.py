"""Gradients of the refined matrix: finite differences, degenerate scenes, the laws."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from fmtorch.core.types import Correspondences, collate
from fmtorch.geometry import refine
from fmtorch.geometry.robust_losses import LOSSES
from tests import laws
from tests.geometry.test_irls_gradients import SCALE, degenerate, first_model, inputs, tolerances


@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_are_those_of_the_optimum(loss: str) -> None:
    """Finite differences of the optimum.

    Points have a noise of 3 px at a focal length of 1000 px, so that Gauss and Newton's Hessian would not do: it misses
    these gradients by 2 % and more.
    """
    x0, x1, F, weight = inputs(2, outliers=1)
    converged = refine(F, x0, x1, weight, loss=loss, scale=SCALE, iterations=40)

    def function(x0: Tensor, x1: Tensor, w: Tensor) -> Tensor:
        return refine(converged, x0, x1, w, loss=loss, scale=SCALE, iterations=40)

    attached = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    # A cost of some 1e-4 that is known to 1e-16 of it has its least place at 1e-8; steps of 1e-4 give 1e-4.
    options = {**tolerances(loss), "eps": 1e-4, "rtol": 1e-3, "atol": 1e-3}
    assert torch.autograd.gradcheck(function, attached, **options)


def test_nothing_is_recorded_without_need() -> None:
    x0, x1, F, weight = inputs(3)
    plain = refine(F, x0, x1, weight, scale=SCALE)
    assert not plain.requires_grad
    attached = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    first = F.clone().requires_grad_()
    assert not refine(first, x0, x1, weight, scale=SCALE).requires_grad
    with torch.no_grad():
        assert not refine(first, *attached, scale=SCALE).requires_grad
    fitted = refine(first, *attached, scale=SCALE)
    assert fitted.requires_grad
    assert torch.equal(fitted, plain)


@pytest.mark.parametrize("kind", degenerate())
def test_gradients_are_finite_and_do_not_touch_neighbours(kind: str) -> None:
    """A good pair beside a degenerate one has the bits it has alone, and the gradients up to rounding."""
    good, bad = laws.scene(1), degenerate()[kind]
    size = {"very small": 1e-9, "very large": 1e9}.get(kind, 1.0)
    shrink = torch.diag(torch.tensor([1 / size, 1 / size, 1.0], dtype=torch.float64))
    F0 = torch.stack([first_model(), shrink @ first_model() @ shrink, first_model()])
    pairs = [pair.replace(x0=pair.x0.double(), x1=pair.x1.double()) for pair in (good, bad, laws.scene(2))]

    def refined(c: Correspondences, F0: Tensor) -> tuple[Tensor, list[Tensor]]:
        assert c.prior is not None
        x0, x1, weight = attached = [v.double().clone().requires_grad_() for v in (c.x0, c.x1, c.prior)]
        scale = torch.tensor([2.0, 2.0 * size, 2.0], dtype=torch.float64)[: len(F0)]
        F = refine(F0, x0, x1, weight, c.mask, loss="cauchy", scale=scale)
        return F.detach(), list(torch.autograd.grad(F.sum(), attached))

    c = collate(pairs)
    F, gradients = refined(c, F0)
    assert bool(F.isfinite().all())
    for g in gradients:
        assert bool(g.isfinite().all())
        assert bool((g[~c.mask] == 0).all())
    alone, its_gradients = refined(pairs[0], F0[:1])
    assert torch.equal(F[0], alone[0])
    n = good.mask.shape[1]
    for g, own in zip(gradients, its_gradients, strict=True):
        torch.testing.assert_close(g[0, :n], own[0], rtol=1e-8, atol=1e-8 * float(own.abs().max()))


def test_what_is_no_model_has_no_gradient() -> None:
    x0, x1, F, weight = inputs(3)
    pool = torch.stack([F, F * torch.nan, F * 0, torch.ones_like(F)])
    attached = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    fitted = refine(pool, *attached, scale=SCALE)
    # The last one may be refined to something; the two before it add nothing.
    for g in torch.autograd.grad(fitted.sum(), attached, retain_graph=True):
        assert bool(g.isfinite().all())
    alone = refine(F, *attached, scale=SCALE)
    sums = [torch.autograd.grad(f.sum(), attached, retain_graph=True) for f in (fitted[:3], alone)]
    for g, own in zip(*sums, strict=True):
        torch.testing.assert_close(g, own, rtol=1e-8, atol=1e-8 * float(own.abs().max()))
