"""The Sampson error of homographies and its minimum equal their definitions."""

from typing import NamedTuple

import numpy as np
import pytest
import torch

from fmtorch.geometry import LOSSES
from fmtorch.geometry.epipolar import HOMOGRAPHY
from fmtorch.geometry.homography_refine import (
    evaluate_homographies,
    homography_curvature,
    homography_gradient,
    linearise_homography,
    refine_homographies,
)
from fmtorch.geometry.levenberg_marquardt import LOSS_CODES, NO_TABLE, Schedule, Weighted
from tests.reference import homography as reference

EPS = 2.0**-52
KINDS = sorted(reference.LOSSES)


class Problem(NamedTuple):
    """A model (9,) of unit norm, noisy matches (4, n) of it, weights (n,) and squared scales (n,)."""

    h: np.ndarray
    points: np.ndarray
    weight: np.ndarray
    s2: np.ndarray

    def weighted(self, loss: str) -> Weighted:
        return Weighted(self.points, self.weight, self.s2, LOSS_CODES[loss], NO_TABLE)

    def unbounded(self) -> Weighted:
        """Without a robust loss."""
        return Weighted(self.points, self.weight, np.full_like(self.s2, np.inf), LOSS_CODES["truncated"], NO_TABLE)


def problem(seed: int, n: int = 30, noise: float = 0.02) -> Problem:
    """The first two matches have no weight, the third is wrong."""
    rng = np.random.default_rng(seed)
    h = (np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3))).ravel()
    x0 = rng.uniform(-1, 1, (n, 2))
    points = np.ascontiguousarray(np.c_[x0, reference.mapped(h, x0)].T) + noise * rng.normal(size=(4, n))
    points[2:, 2] = rng.uniform(-1, 1, 2)
    weight, s2 = rng.uniform(0.2, 1, n), (noise * rng.uniform(0.8, 3, n)) ** 2
    weight[:2] = 0
    return Problem(h / np.linalg.norm(h), points, weight, s2)


def evaluated(h: np.ndarray, matches: Weighted) -> tuple[np.ndarray, float]:
    products, cost = np.empty((1, 10, 10)), np.empty(1)
    evaluate_homographies(h[None].copy(), matches, True, products, cost)
    return products[0], float(cost[0])


def behind(each: Problem) -> Problem:
    """The same with the fourth match on the other side of the horizon, far from its weight on this one."""
    points = each.points.copy()
    points[:2, 3] = -2 * each.h[6:8] / (each.h[6:8] @ each.h[6:8]) * each.h[8]
    return each._replace(points=points)


def test_three_forms_of_the_error_equal_its_definition() -> None:
    for seed in range(20):
        p = behind(problem(seed))
        expected = np.array([reference.sampson_squared(p.h, match) for match in p.points.T])
        assert np.isinf(expected[3])
        assert np.isfinite(np.delete(expected, 3)).all()
        error = linearise_homography(torch.from_numpy(p.h[:, None]), torch.from_numpy(p.points))
        tensors = torch.where(error.front, error.squared, torch.inf)
        one_by_one = [HOMOGRAPHY.of_match(p.h, *match) for match in p.points.T]
        # e cancels from terms of about 1, so r is exact to a few dozen roundings; r^2 to 2 r of these.
        atol = 100 * EPS * np.sqrt(expected.min()) + 1e4 * EPS**2
        for computed in (tensors.numpy(), np.array(one_by_one)):
            np.testing.assert_allclose(computed, expected, rtol=1e-11, atol=atol)


@pytest.mark.parametrize("loss", KINDS)
def test_cost_and_gradient(loss: str) -> None:
    for seed in range(5):
        p = problem(seed)

        def cost(h: np.ndarray, p: Problem = p) -> complex:
            return reference.robust_sum(h, p.points, p.weight, p.s2, loss)

        products, computed = evaluated(p.h, p.weighted(loss))
        # Sums of 30 terms, each exact to 100 roundings over a residual of 1e-3 of coordinates of 1.
        assert computed == pytest.approx(float(np.real(cost(p.h))), rel=1e-10)
        slope = reference.gradient(cost, p.h)
        np.testing.assert_allclose(2 * products[9, :9], slope, atol=1e-10 * np.abs(slope).max())
        assert abs(products[9, :9] @ p.h) < 1e-10 * np.abs(slope).max()  # the scale of H counts nothing


def test_gauss_newton_matrix() -> None:
    for seed in range(5):
        p = problem(seed)
        expected = reference.gauss_newton(p.h, p.points, p.weight)
        computed, _ = evaluated(p.h, p.unbounded())
        np.testing.assert_allclose(computed[:9, :9], expected, atol=1e-11 * np.abs(expected).max())
        np.testing.assert_array_equal(computed, computed.T)


@pytest.mark.parametrize("loss", KINDS)
def test_refinement_ends_where_the_gradient_vanishes(loss: str) -> None:
    for seed in range(5):
        p = problem(seed, n=60)
        rng = np.random.default_rng(seed)
        start = p.h + 0.005 * rng.normal(size=(2, 9))
        out, cost = np.empty((2, 9)), np.empty(2)
        refine_homographies(start, p.weighted(loss), Schedule(100, 1e-4, 0.0), out, cost)
        for h, before, after in zip(out, start, cost, strict=True):
            assert np.linalg.norm(h) == pytest.approx(1, abs=4 * EPS)
            assert after == pytest.approx(reference.robust_sum(h, p.points, p.weight, p.s2, loss).real, rel=1e-10)
            assert after <= reference.robust_sum(before, p.points, p.weight, p.s2, loss).real
            products, _ = evaluated(h, p.weighted(loss))
            # A step is refused once it lowers the cost by less than its rounding, EPS: gradients of sqrt(EPS) stay.
            size = np.sqrt(np.diagonal(products)[:9] * after)
            assert (np.abs(products[9, :9]) <= 1e-6 * size).all()


@pytest.mark.parametrize("loss", KINDS)
def test_gradient_in_tensors_and_its_graph(loss: str) -> None:
    p = behind(problem(3, n=12))
    h, points, weight, s2 = (
        torch.from_numpy(a) for a in (p.h[:, None, None], p.points[:, None].copy(), p.weight[None], p.s2[None])
    )
    expected, _ = evaluated(p.h, p.weighted(loss))
    computed = homography_gradient(h, points, weight, LOSSES[loss], s2)
    np.testing.assert_allclose(computed[:, 0, 0].numpy(), expected[9, :9], atol=1e-11 * np.abs(expected).max())
    points.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: homography_gradient(h, x, weight, LOSSES[loss], s2), points)


def test_gauss_newton_matrix_in_tensors() -> None:
    p = problem(4)
    h, points, weight = (torch.from_numpy(a) for a in (p.h[:, None, None], p.points[:, None].copy(), p.weight[None]))
    unbounded = torch.full((1, 1), torch.inf, dtype=torch.float64)
    computed = homography_curvature(h, points, weight, LOSSES["truncated"], unbounded)[0, 0].numpy()
    expected = reference.gauss_newton(p.h, p.points, p.weight)
    np.testing.assert_allclose(computed, expected, atol=1e-11 * np.abs(expected).max())
