"""Levenberg-Marquardt on the manifold of rank 2 by kernels, against its definition."""

import numpy as np
import pytest
import torch

from fmtorch.geometry.irls import reweighted, reweighted_kernel
from fmtorch.geometry.levenberg_marquardt import FIRST_DAMPING, LOSS_CODES, Schedule, Weighted, evaluate
from fmtorch.geometry.normalize import RobustSum
from fmtorch.geometry.rank2_manifold import SQUARINGS
from fmtorch.geometry.refine import refine_kernel
from tests.estimators.pairs import apart
from tests.reference import refine as reference
from tests.reference.solvers import skew

SCALE = 0.02


def matches(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Models (5, 9) near matches' own, points (4, n), weights and squared scales (n,)."""
    rng = np.random.default_rng(seed)
    X = np.concatenate([rng.uniform(-1, 1, (n, 2)), rng.uniform(2, 4, (n, 1))], 1)
    R, _ = np.linalg.qr(np.eye(3) + 0.2 * rng.normal(size=(3, 3)))
    R *= np.sign(np.linalg.det(R))
    t = rng.normal(size=3) * 0.5
    x0, x1 = X[:, :2] / X[:, 2:], (X @ R.T + t)[:, :2] / (X @ R.T + t)[:, 2:]
    points = np.ascontiguousarray(np.concatenate([x0, x1], 1).T + 0.003 * rng.normal(size=(4, n)))
    F = (skew(t) @ R).ravel() + 0.02 * rng.normal(size=(5, 9))
    return F, points, rng.random(n), (SCALE * rng.uniform(0.5, 2, n)) ** 2


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
    refine_kernel(F, SQUARINGS, weighted, Schedule(iterations, FIRST_DAMPING, tolerance), fitted, cost)
    return fitted, cost


@pytest.mark.parametrize("tolerance", [0.0, 1e-3])
@pytest.mark.parametrize("loss", LOSS_CODES)
def test_refinement(loss: str, tolerance: float) -> None:
    F, points, weight, s2 = matches(200)
    for iterations in (0, 1, 3, 8):
        fitted, cost = refined(F, points, weight, s2, loss, iterations, tolerance)
        for i, start in enumerate(F):
            expected, expected_cost = reference.levenberg_marquardt(
                start, points, weight, s2, loss, iterations, FIRST_DAMPING, tolerance
            )
            assert cost[i] == pytest.approx(expected_cost, rel=1e-9)
            assert apart(fitted[i], expected) < 1e-8
        assert np.abs(np.linalg.det(fitted.reshape(-1, 3, 3))).max() < 1e-14


def test_what_cannot_be_refined_is_told() -> None:
    F, points, weight, s2 = matches(50)
    F[1], F[2] = 0, np.nan
    fitted, cost = refined(F, points, weight, s2, "truncated", 3, 0.0)
    assert np.isfinite(cost).tolist() == [True, False, False, True, True]
    alone, alone_cost = refined(F[3:4].copy(), points, weight, s2, "truncated", 3, 0.0)
    np.testing.assert_array_equal(alone[0], fitted[3])
    assert alone_cost[0] == cost[3]
