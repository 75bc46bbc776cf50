"""Refinement on the manifold of rank 2, in tensors and by kernels."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.geometry import LOSSES, attached_step, irls, refine
from fmtorch.geometry.epipolar import linearise
from fmtorch.geometry.levenberg_marquardt import FIRST_DAMPING, LOSS_CODES, Schedule, Weighted, evaluate
from fmtorch.geometry.normalize import RobustSum, fitted_by
from fmtorch.geometry.refine import refine_kernel, reweighted, reweighted_kernel
from tests.estimators.pairs import apart
from tests.geometry.scenes import SCALE, distance, near_scene, tolerances, unit_scene
from tests.reference import refine as reference


def components(x0: np.ndarray, x1: np.ndarray) -> Tensor:
    return torch.from_numpy(np.c_[x0, x1].T.copy())[:, None]


def models(F: np.ndarray, k: int, spread: float, seed: int = 0) -> Tensor:
    return torch.from_numpy(F.reshape(9, 1, 1) + np.random.default_rng(seed).normal(0, spread, (9, 1, k)))


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("seed", range(2))
def test_robust_optimum_equals_scipy(loss: str, seed: int) -> None:
    F, x0, x1 = unit_scene(seed, 120, noise=2e-3, outliers=30)
    scale = 0.01
    F0 = models(F, 1, 1e-3, seed)
    ones = torch.ones(1, 120, dtype=torch.float64)
    s2 = torch.full((1, 1), scale**2, dtype=torch.float64)
    fitted, cost = fitted_by(refine_kernel, F0, RobustSum(components(x0, x1), ones, loss, s2), 60)
    # From our optimum SciPy, which knows another parametrisation and numerical gradients, cannot get lower.
    _, min_cost = reference.optimum(fitted[:, 0, 0].reshape(3, 3).numpy(), x0, x1, np.ones(120), loss, scale)
    # The tabulated loss is linear between its entries, whose integral is off by up to 1e-7.
    assert cost.item() == pytest.approx(min_cost, rel=1e-6 if loss == "magsac" else 1e-8)
    if loss in ("geman_mcclure", "truncated"):  # bounded losses; the others let a quarter of outliers move F far
        assert distance(fitted[:, 0, 0], torch.from_numpy(F.flatten())) < 0.05


def test_empty_and_unknown() -> None:
    F = torch.eye(3, dtype=torch.float64)
    none = torch.zeros(0, 2, dtype=torch.float64)
    assert refine(F, none, none).shape == (3, 3)
    with pytest.raises(ValueError, match="loss"):
        refine(F, none, none, loss="none")


@pytest.mark.parametrize(("loss", "outliers"), [*((name, 0) for name in LOSSES), ("truncated", 6)])
def test_attached_step_has_the_gradient_of_the_optimum(loss: str, outliers: int) -> None:
    F, a, b = unit_scene(2, 30, noise=1e-4, outliers=outliers)
    x0, x1 = torch.from_numpy(a), torch.from_numpy(b)
    rng = np.random.default_rng(0)
    weight = torch.from_numpy(rng.uniform(0.2, 1, 30))
    direction = torch.from_numpy(rng.normal(size=(3, 3)))
    arguments = {"loss": loss, "scale": 0.02}

    def optimum(x0: Tensor, x1: Tensor, weight: Tensor) -> Tensor:
        return refine(torch.from_numpy(F), x0, x1, weight, iterations=30, **arguments)

    inputs = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    best = optimum(x0, x1, weight)
    stepped = attached_step(best, *inputs, **arguments)
    assert distance(best.flatten(), stepped.detach().flatten()) < 1e-8
    gradients = torch.autograd.grad((stepped * direction).sum(), inputs)
    for i, gradient in enumerate(gradients):
        move = torch.from_numpy(rng.normal(size=inputs[i].shape))
        h = 1e-4 if i == 2 else 1e-6  # moves of the optimum well above its own precision, some 1e-10
        ends = []
        for sign in (-1, 1):
            moved = [x0, x1, weight]
            moved[i] = moved[i] + sign * h * move
            ends.append((optimum(*moved) * direction).sum().item())
        difference = (ends[1] - ends[0]) / (2 * h)
        # Gauss and Newton neglect terms of the size of the residuals over that of the scene, 1e-4, times its condition.
        assert (gradient * move).sum().item() == pytest.approx(difference, rel=2e-2)


@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_are_those_of_the_optimum(loss: str) -> None:
    """Finite differences of the optimum. Points have a noise of 3 px at a focal length of 1000 px, so that Gauss and
    Newton's Hessian would not do: it misses these gradients by 2 % and more."""
    x0, x1, F, weight = near_scene(2, outliers=1)
    converged = refine(F, x0, x1, weight, loss=loss, scale=SCALE, iterations=40)

    def function(x0: Tensor, x1: Tensor, w: Tensor) -> Tensor:
        return refine(converged, x0, x1, w, loss=loss, scale=SCALE, iterations=40)

    attached = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    # A cost of some 1e-4 that is known to 1e-16 of it has its least place at 1e-8; steps of 1e-4 give 1e-4.
    options = {**tolerances(loss), "eps": 1e-4, "rtol": 1e-3, "atol": 1e-3}
    assert torch.autograd.gradcheck(function, attached, **options)


@pytest.mark.parametrize("fit", [refine, irls], ids=["refine", "irls"])
def test_nothing_is_recorded_without_need(fit: Callable[..., Tensor]) -> None:
    x0, x1, F, weight = near_scene(3)

    def fitted(x0: Tensor, x1: Tensor, F: Tensor, weight: Tensor) -> Tensor:
        return refine(F, x0, x1, weight, scale=SCALE) if fit is refine else irls(x0, x1, F, weight, scale=SCALE)

    plain = fitted(x0, x1, F, weight)
    assert not plain.requires_grad
    attached, first = [v.clone().requires_grad_() for v in (x0, x1, weight)], F.clone().requires_grad_()
    assert not fitted(x0, x1, first, weight).requires_grad
    with torch.no_grad():
        assert not fitted(*attached[:2], first, attached[2]).requires_grad
    recorded = fitted(*attached[:2], first, attached[2])
    assert recorded.requires_grad
    assert torch.equal(recorded, plain)


def matches(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Models (5, 9) near matches' own, points (4, n), weights and squared scales (n,)."""
    rng = np.random.default_rng(seed)
    F, x0, x1 = unit_scene(seed, n, noise=0.003)
    models, points = F.ravel() + 0.02 * rng.normal(size=(5, 9)), np.ascontiguousarray(np.c_[x0, x1].T)
    return models, points, rng.random(n), (SCALE * rng.uniform(0.5, 2, n)) ** 2


@pytest.mark.parametrize("n", [8, 32, 300])
@pytest.mark.parametrize("loss", LOSS_CODES)
def test_costs_and_normal_equations(loss: str, n: int) -> None:
    F, points, weight, s2 = matches(n)
    normal, expected_cost = zip(*(reference.normal_equations(f, points, weight, s2, loss) for f in F), strict=True)
    for derivatives in (True, False):
        products, cost = np.zeros((5, 10, 10)), np.empty(5)
        evaluate(F, Weighted.of(points, weight, s2, loss), derivatives, products, cost)
        np.testing.assert_allclose(cost, expected_cost, rtol=1e-11)
        if derivatives:
            size = np.sqrt(np.einsum("kii,kjj->kij", normal, normal))  # what the sums of an entry cancel from, at most
            assert (np.abs(products - normal) <= 1e-12 * size + 1e-300).all()
        else:
            assert not products.any()


@pytest.mark.parametrize("n", [8, 32, 300])
@pytest.mark.parametrize("loss", LOSS_CODES)
def test_one_reweighted_fit(loss: str, n: int) -> None:
    F, points, weight, _ = matches(n)
    weight[:2] = [0, 1e-9]
    models, *data = (torch.from_numpy(a) for a in (F.T[:, None].copy(), points[:, None], weight[None]))
    error = RobustSum(*data, loss, torch.full((1, 1), SCALE**2, dtype=torch.float64))
    expected = reweighted(models, error)[:, 0].T.numpy()
    fitted, s2 = F.copy(), np.full(n, SCALE**2)
    reweighted_kernel(fitted, Weighted.of(points, weight, s2, loss))
    for fit, other in zip(fitted, expected, strict=True):
        # Rounding of the sums over the gap of their eigenvalues, 1e-8 of the largest.
        assert apart(fit, other) < 1e-8
    kept = F.copy()  # where the weights determine no model
    none = np.where(np.arange(n) < 6, weight, 0)
    reweighted_kernel(kept, Weighted.of(points, none, s2, loss))
    np.testing.assert_array_equal(kept, F)


def refined(
    F: np.ndarray, points: np.ndarray, weight: np.ndarray, s2: np.ndarray, loss: str, iterations: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    fitted, cost = np.empty_like(F), np.empty(len(F))
    weighted = Weighted.of(points, weight, s2, loss)
    refine_kernel(F, weighted, Schedule(iterations, tolerance=tolerance), fitted, cost)
    return fitted, cost


@pytest.mark.parametrize("tolerance", [0.0, 1e-3])
@pytest.mark.parametrize("loss", LOSS_CODES)
def test_refinement(loss: str, tolerance: float) -> None:
    F, *data = matches(200)
    for iterations in (0, 1, 3, 8):
        expect_refined(F, *data, loss, iterations, tolerance)


def expect_refined(F: np.ndarray, *given: Any) -> None:
    """What the reference makes of the models; given: data, loss, iterations and tolerance."""
    fitted, cost = refined(F, *given)
    for i, start in enumerate(F):
        expected, expected_cost = reference.levenberg_marquardt(start, *given[:-1], FIRST_DAMPING, given[-1])
        assert cost[i] == pytest.approx(expected_cost, rel=1e-9)
        assert apart(fitted[i], expected) < 1e-8
    assert np.abs(np.linalg.det(fitted.reshape(-1, 3, 3))).max() < 1e-14


def test_rejected_steps_are_made_again_with_more_damping_and_end_no_fit() -> None:
    """From afar: a step that raises the cost is no sign that the fit has converged."""
    F, *data = matches(60)
    F = F[0] + 0.5 * np.random.default_rng(5).normal(size=(40, 9))
    costs = np.array([refined(F, *data, "huber", iterations, 0.0)[1] for iterations in range(9)])
    assert (np.diff(costs, axis=0) <= 0).all()
    rejected = ((costs[1:] == costs[:-1]) & (costs[8] < 0.99 * costs[:-1])).any(0)
    assert rejected.sum() >= 3
    expect_refined(F[rejected], *data, "huber", 8, 1e-3)


def test_what_cannot_be_refined_is_reported() -> None:
    F, points, weight, s2 = matches(50)
    F[1], F[2] = 0, np.nan
    fitted, cost = refined(F, points, weight, s2, "truncated", 3, 0.0)
    assert np.isfinite(cost).tolist() == [True, False, False, True, True]
    alone, alone_cost = refined(F[3:4].copy(), points, weight, s2, "truncated", 3, 0.0)
    np.testing.assert_array_equal(alone[0], fitted[3])
    assert alone_cost[0] == cost[3]


@pytest.mark.parametrize("seed", range(4))
def test_jacobian_equals_autograd(seed: int) -> None:
    F, x0, x1 = unit_scene(seed, 40, noise=0.05)
    f = models(F, 1, 0.1, seed)

    def residual(f: Tensor) -> Tensor:
        h0 = torch.from_numpy(np.c_[x0, np.ones(len(x0))])
        h1 = torch.from_numpy(np.c_[x1, np.ones(len(x1))])
        line1, line0 = h0 @ f.reshape(3, 3).T, h1 @ f.reshape(3, 3)
        return (h1 * line1).sum(1) / (line1[:, :2].square().sum(1) + line0[:, :2].square().sum(1)).sqrt()

    J, e, inverse, r2 = linearise(f, components(x0, x1))
    jacobian = (J.flatten(0, 1) * inverse.sqrt())[:, 0, 0].T
    assert torch.allclose(e * e * inverse, r2)
    expected = torch.autograd.functional.jacobian(residual, f.flatten())
    assert torch.allclose(jacobian, expected, rtol=0, atol=1e-9 * float(expected.abs().max()))
    # r^2 of outliers is of order 1, of relative precision 1e-15
    assert torch.allclose(r2.flatten(), residual(f.flatten()).square(), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("loss", LOSSES)
def test_cost_never_rises(loss: str) -> None:
    F, x0, x1 = unit_scene(7, 90, noise=5e-3, outliers=40)
    F0 = torch.cat([models(F, 10, 0.05), models(F, 10, 1.0)], 2)
    weight = torch.from_numpy(np.random.default_rng(0).uniform(0, 1, (1, 90)))
    error = RobustSum(components(x0, x1), weight, loss, torch.full((1, 1), 0.02**2, dtype=torch.float64))
    costs = [fitted_by(refine_kernel, F0, error, i)[1] for i in range(8)]
    for before, after in itertools.pairwise(costs):
        assert bool((after <= before).all())
    assert bool((costs[-1] < costs[0])[:, :10].any())
