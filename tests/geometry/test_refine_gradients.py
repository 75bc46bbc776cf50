"""Gradients of the refined matrix: finite differences, both kinds, degenerate scenes, the laws."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.core.types import Correspondences, collate
from fmtorch.geometry import refine
from fmtorch.geometry.robust_losses import KERNELS
from tests import laws
from tests.geometry.test_irls_gradients import GRADIENTS, SCALE, degenerate, first_model, inputs, tolerances


@pytest.mark.parametrize("kernel", KERNELS)
def test_unrolled_gradients_are_those_of_the_function(kernel: str) -> None:
    """To points, first model and weights, one of them zero, far from convergence.

    There the steps depend on the centre of the coordinates, a constant: two matches of no weight hold it in its place.
    """
    values = inputs(1)
    values[3][5] = 0.0
    corners = torch.tensor([[-3.0, -3.0], [3.0, 3.0]], dtype=torch.float64)

    def function(x0: Tensor, x1: Tensor, F: Tensor, w: Tensor) -> Tensor:
        x0, x1 = (torch.cat([x, corners]) for x in (x0, x1))
        # Negative weights are not allowed, so finite differences at zero need some room.
        w = torch.nn.functional.pad(w + 1e-5, (0, 2))
        return refine(F, x0, x1, w, kernel=kernel, scale=SCALE, iterations=3, gradient="unrolled")

    attached = [v.clone().requires_grad_() for v in values]
    assert torch.autograd.gradcheck(function, attached, **tolerances(kernel))


@pytest.mark.parametrize("kernel", KERNELS)
def test_implicit_gradients_are_those_of_the_optimum(kernel: str) -> None:
    """Finite differences of the optimum, and the gradients through all the steps to it.

    Points have a noise of 3 px at a focal length of 1000 px, so that Gauss and Newton's Hessian would not do: it misses
    these gradients by 2 % and more.
    """
    x0, x1, F, weight = inputs(2, outliers=1)
    converged = refine(F, x0, x1, weight, kernel=kernel, scale=SCALE, iterations=40)

    def function(x0: Tensor, x1: Tensor, w: Tensor, gradient: str, F: Tensor = converged) -> Tensor:
        return refine(F, x0, x1, w, kernel=kernel, scale=SCALE, iterations=40, gradient=gradient)

    attached = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    # A cost of some 1e-4 that is known to 1e-16 of it has its least place at 1e-8; steps of 1e-4 give 1e-4.
    options = {**tolerances(kernel), "eps": 1e-4, "rtol": 1e-3, "atol": 1e-3}
    assert torch.autograd.gradcheck(functools.partial(function, gradient="implicit"), attached, **options)
    direction = torch.from_numpy(np.random.default_rng(0).normal(size=(3, 3)))
    both = [torch.autograd.grad((function(*attached, kind, F) * direction).sum(), attached) for kind in GRADIENTS]
    for by_implicit, by_unrolled in zip(*both, strict=True):
        # Both are at 1e-8 from the optimum, as above, times the third derivatives, some 1e2.
        torch.testing.assert_close(by_implicit, by_unrolled, rtol=1e-5, atol=1e-5 * float(by_unrolled.abs().max()))


def test_nothing_is_recorded_without_need() -> None:
    x0, x1, F, weight = inputs(3)
    plain = refine(F, x0, x1, weight, scale=SCALE)
    assert not plain.requires_grad
    attached = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    first = F.clone().requires_grad_()
    assert not refine(first, x0, x1, weight, scale=SCALE).requires_grad
    with torch.no_grad():
        assert not refine(first, *attached, scale=SCALE).requires_grad
    for gradient in GRADIENTS:
        fitted = refine(first, *attached, scale=SCALE, gradient=gradient)
        assert fitted.requires_grad
        assert torch.equal(fitted, plain)
    with pytest.raises(ValueError, match="gradient is 'none'"):
        refine(F, x0, x1, gradient="none")


@pytest.mark.parametrize("gradient", GRADIENTS)
@pytest.mark.parametrize("kind", degenerate())
def test_gradients_are_finite_and_do_not_touch_neighbours(kind: str, gradient: str) -> None:
    """A good pair beside a degenerate one has the bits it has alone, and the gradients up to rounding."""
    good, bad = laws.scene(1), degenerate()[kind]
    size = {"very small": 1e-9, "very large": 1e9}.get(kind, 1.0)
    shrink = torch.diag(torch.tensor([1 / size, 1 / size, 1.0], dtype=torch.float64))
    F0 = torch.stack([first_model(), shrink @ first_model() @ shrink, first_model()])
    pairs = [pair.replace(x0=pair.x0.double(), x1=pair.x1.double()) for pair in (good, bad, laws.scene(2))]

    def refined(c: Correspondences, F0: Tensor) -> tuple[Tensor, list[Tensor]]:
        assert c.prior is not None
        attached = [v.double().clone().requires_grad_() for v in (c.x0, c.x1, c.prior, F0)]
        x0, x1, weight, first = attached
        scale = torch.tensor([2.0, 2.0 * size, 2.0], dtype=torch.float64)[: len(F0)]
        F = refine(first, x0, x1, weight, c.mask, kernel="cauchy", scale=scale, gradient=gradient)
        gradients = torch.autograd.grad(F.sum(), attached, allow_unused=gradient == "implicit")
        return F.detach(), [g for g in gradients if g is not None]

    c = collate(pairs)
    F, gradients = refined(c, F0)
    assert bool(F.isfinite().all())
    assert len(gradients) == (3 if gradient == "implicit" else 4)
    for g in gradients:
        assert bool(g.isfinite().all())
    for g in gradients[:3]:
        assert bool((g[~c.mask] == 0).all())
    alone, its_gradients = refined(pairs[0], F0[:1])
    assert torch.equal(F[0], alone[0])
    n = good.mask.shape[1]
    for g, own in zip(gradients, its_gradients, strict=True):
        torch.testing.assert_close(g[0, :n], own[0], rtol=1e-8, atol=1e-8 * float(own.abs().max()))


@pytest.mark.parametrize("gradient", GRADIENTS)
def test_what_is_no_model_has_no_gradient(gradient: str) -> None:
    x0, x1, F, weight = inputs(3)
    pool = torch.stack([F, F * torch.nan, F * 0, torch.ones_like(F)]).requires_grad_()
    attached = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    fitted = refine(pool, *attached, scale=SCALE, gradient=gradient)
    # The last one may be refined to something; the two before it add nothing.
    for g in torch.autograd.grad(fitted.sum(), attached, retain_graph=True):
        assert bool(g.isfinite().all())
    alone = refine(F, *attached, scale=SCALE, gradient=gradient)
    sums = [torch.autograd.grad(f.sum(), attached, retain_graph=True) for f in (fitted[:3], alone)]
    for g, own in zip(*sums, strict=True):
        torch.testing.assert_close(g, own, rtol=1e-8, atol=1e-8 * float(own.abs().max()))
    if gradient == "unrolled":
        (to_pool,) = torch.autograd.grad(fitted.sum(), pool)
        assert bool(to_pool.isfinite().all())
        assert bool((to_pool[1:3] == 0).all())
