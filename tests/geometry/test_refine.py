"""Refinement on the manifold of rank 2, in tensors and by kernels."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.geometry import LOSSES, attached_step, irls, refine
from fmtorch.geometry.levenberg_marquardt import LOSS_CODES, Schedule, Weighted, evaluate
from fmtorch.geometry.normalize import RobustSum, fitted_by
from fmtorch.geometry.refine import refine_kernel, reweighted, reweighted_kernel
from tests.estimators.pairs import apart
from tests.geometry.scenes import SCALE, distance, near_scene, tolerances, unit_scene
from tests.reference import refine as reference


def components(x0: np.ndarray, x1: np.ndarray) -> Tensor:
    return torch.from_numpy(np.c_[x0, x1].T.copy())[:, None]


def models(F: np.ndarray, k: int, spread: float, seed: int = 0) -> Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(F.reshape(9, 1, 1) + rng.normal(0, spread, (9, 1, k)))


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
    inputs = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    best = refine(torch.from_numpy(F), *inputs, iterations=30, **arguments)
    stepped = attached_step(best.detach(), *inputs, **arguments)
    assert distance(best.detach().flatten(), stepped.detach().flatten()) < 1e-8
    gradients = zip(*(torch.autograd.grad((each * direction).sum(), inputs) for each in (stepped, best)), strict=True)
    for approximate, exact in gradients:
        # Gauss and Newton neglect terms of the size of the residuals over that of the scene, 1e-4, times its condition.
        torch.testing.assert_close(approximate, exact, rtol=2e-2, atol=2e-2 * float(exact.abs().max()))


@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_are_those_of_the_optimum(loss: str) -> None:
    """Finite differences of the optimum.
    Points have a noise of 3 px at a focal length of 1000 px, so that Gauss and Newton's Hessian would not do: it misses
    these gradients by 2 % and more."""
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
    """Models and costs by the kernel."""
    fitted, cost = np.empty_like(F), np.empty(len(F))
    weighted = Weighted.of(points, weight, s2, loss)
    refine_kernel(F, weighted, Schedule(iterations, tolerance=tolerance), fitted, cost)
    return fitted, cost


@pytest.mark.parametrize("loss", LOSS_CODES)
def test_costs_fall_to_the_optimum(loss: str) -> None:
    """From near; a tolerance ends most of them hardly earlier. From afar, where steps are rejected and made again with
    more damping: one that raises the cost is no sign that the fit has converged."""
    F, *data = matches(60)
    for start in (F, F[0] + 0.5 * np.random.default_rng(5).normal(size=(40, 9))):
        costs = np.array([refined(start, *data, loss, iterations, 0.0)[1] for iterations in range(9)])
        assert (np.diff(costs, axis=0) <= 0).all()
        fitted, ended = refined(start, *data, loss, 8, 1e-3)
        assert np.abs(np.linalg.det(fitted.reshape(-1, 3, 3))).max() < 1e-14
        assert np.median(ended / costs[8]) < 1.001
    rejected = ((costs[1:] == costs[:-1]) & (costs[8] < 0.99 * costs[:-1])).any(0)
    assert rejected.sum() >= 3


def test_what_cannot_be_refined_is_told() -> None:
    F, points, weight, s2 = matches(50)
    F[1], F[2] = 0, np.nan
    fitted, cost = refined(F, points, weight, s2, "truncated", 3, 0.0)
    assert np.isfinite(cost).tolist() == [True, False, False, True, True]
    alone, alone_cost = refined(F[3:4].copy(), points, weight, s2, "truncated", 3, 0.0)
    np.testing.assert_array_equal(alone[0], fitted[3])
    assert alone_cost[0] == cost[3]
