from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.geometry.epipolar import homogeneous, linearise
from fmtorch.geometry.rank2_manifold import start
from fmtorch.geometry.refine import attached_step, refine, refine_components
from fmtorch.geometry.robust_losses import LOSSES
from tests.conftest import oracle
from tests.geometry.scenes import unit_scene
from tests.reference import refine as reference


def components(x0: np.ndarray, x1: np.ndarray) -> Tensor:
    return torch.from_numpy(np.c_[x0, x1].T.copy())[:, None]


def models(F: np.ndarray, k: int, spread: float, seed: int = 0) -> Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(F.reshape(9, 1, 1) + rng.normal(0, spread, (9, 1, k)))


def distance(A: Tensor, B: Tensor) -> Tensor:
    """Of matrices (9, ...) of unit norm, up to sign."""
    return torch.minimum((A - B).norm(dim=0), (A + B).norm(dim=0))


@pytest.mark.parametrize("seed", range(4))
def test_jacobian_equals_autograd(seed: int) -> None:
    F, x0, x1 = unit_scene(seed, 40, noise=0.05)
    f = models(F, 1, 0.1, seed)

    def residual(f: Tensor) -> Tensor:
        h0 = torch.from_numpy(np.c_[x0, np.ones(len(x0))])
        h1 = torch.from_numpy(np.c_[x1, np.ones(len(x1))])
        line1, line0 = h0 @ f.reshape(3, 3).T, h1 @ f.reshape(3, 3)
        return (h1 * line1).sum(1) / (line1[:, :2].square().sum(1) + line0[:, :2].square().sum(1)).sqrt()

    J, e, inverse, r2 = linearise(f, homogeneous(components(x0, x1)[:, None, :, None]))
    jacobian = (J.flatten(0, 1) * inverse.sqrt())[:, 0, 0, 0].T
    assert torch.allclose(e * e * inverse, r2)
    expected = torch.autograd.functional.jacobian(residual, f.flatten())
    assert torch.allclose(jacobian, expected, rtol=0, atol=1e-9 * float(expected.abs().max()))
    # r^2 of outliers is of order 1, of relative precision 1e-15
    assert torch.allclose(r2.flatten(), residual(f.flatten()).square(), rtol=1e-12, atol=1e-15)


def test_start_drops_the_smallest_singular_value() -> None:
    rng = np.random.default_rng(0)
    U, V = (np.linalg.qr(rng.normal(size=(50, 3, 3)))[0] for _ in range(2))
    s = np.sort(rng.uniform(0.1, 1, (50, 3)), 1)[:, ::-1] * [1, 1, 0.3]
    F = (U * s[:, None]) @ V.transpose(0, 2, 1)
    nearest = (U[:, :, :2] * s[:, None, :2]) @ V[:, :, :2].transpose(0, 2, 1)
    nearest /= np.linalg.norm(nearest, axis=(1, 2), keepdims=True)
    G, e0, e1 = start(torch.from_numpy(F.reshape(50, 9).T.copy())[:, :, None])
    gap = torch.from_numpy(s[:, 2] / s[:, 1])
    # Five squarings after C^T C: the second vector is left with (s3 / s2)^64; 0.5 would leave 5e-20.
    ok = gap < 0.5
    error = distance(G[..., 0], torch.from_numpy(nearest.reshape(50, 9).T.copy()))
    assert bool((error[ok] < 1e-13).all())
    assert bool(ok.any())
    M = G[..., 0].T.reshape(50, 3, 3)
    assert bool((torch.linalg.svdvals(M)[:, 2] < 1e-15).all())
    assert bool(((M @ e0[..., 0].T[..., None]).norm(dim=1) < 1e-15).all())
    assert bool(((M.mT @ e1[..., 0].T[..., None]).norm(dim=1) < 1e-15).all())


@pytest.mark.parametrize("seed", range(6))
def test_least_squares_optimum_equals_scipy(seed: int) -> None:
    F, x0, x1 = unit_scene(seed, 80, noise=2e-3)
    weight = np.random.default_rng(seed).uniform(0.1, 1, 80)
    F0 = models(F, 3, 0.02, seed)
    infinite = torch.full((1,), torch.inf, dtype=torch.float64)
    fitted, cost = refine_components(F0, components(x0, x1), torch.from_numpy(weight)[None], "truncated", infinite, 40)
    for i in range(3):
        expected, min_cost = reference.optimum(F0[:, 0, i].reshape(3, 3).numpy(), x0, x1, weight)
        assert cost[0, i].item() <= min_cost * (1 + 1e-8)
        direct = (weight * reference.sampson(fitted[:, 0, i].reshape(3, 3).numpy(), x0, x1) ** 2).sum()
        assert cost[0, i].item() == pytest.approx(direct, rel=1e-12)
        # same basin: the same matrix, to the square root of 1e-8 or so
        if abs(cost[0, i].item() / min_cost - 1) < 1e-8:
            assert distance(fitted[:, 0, i], torch.from_numpy(expected.flatten())) < 1e-4


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("seed", range(2))
def test_robust_optimum_equals_scipy(loss: str, seed: int) -> None:
    F, x0, x1 = unit_scene(seed, 120, noise=2e-3, outliers=30)
    scale = 0.01
    F0 = models(F, 1, 1e-3, seed)
    ones = torch.ones(1, 120, dtype=torch.float64)
    fitted, cost = refine_components(F0, components(x0, x1), ones, loss, torch.tensor([scale], dtype=torch.float64), 60)
    # From our optimum SciPy, which knows another parametrisation and numerical gradients, cannot get lower.
    _, min_cost = reference.optimum(fitted[:, 0, 0].reshape(3, 3).numpy(), x0, x1, np.ones(120), loss, scale)
    # The tabulated loss is linear between its entries, whose integral is off by up to 1e-7.
    assert cost.item() == pytest.approx(min_cost, rel=1e-6 if loss == "magsac" else 1e-8)
    if loss in ("geman_mcclure", "truncated"):  # bounded losses; the others let a quarter of outliers move F far
        assert distance(fitted[:, 0, 0], torch.from_numpy(F.flatten())) < 0.05


def test_real_pairs_reach_the_optimum_of_scipy() -> None:
    data = oracle("robust.npz")
    for name in ("000", "001", "005"):
        x0, x1, F = data[f"{name}.X1"], data[f"{name}.X2"], data[f"{name}.F_gt"]
        near = np.abs(reference.sampson(F, x0, x1)) < 2
        x0, x1 = x0[near], x1[near]
        assert len(x0) > 50
        fitted = refine(
            torch.from_numpy(F), torch.from_numpy(x0), torch.from_numpy(x1), scale=float("inf"), iterations=40
        )
        cost = (reference.sampson(fitted.numpy(), x0, x1) ** 2).sum()
        centre0, centre1, size = x0.mean(0), x1.mean(0), np.abs(x0 - x0.mean(0)).max()
        A0, A1 = (np.array([[size, 0, c[0]], [0, size, c[1]], [0, 0, 1]]) for c in (centre0, centre1))
        _, min_cost = reference.optimum(A1.T @ F @ A0, (x0 - centre0) / size, (x1 - centre1) / size, np.ones(len(x0)))
        assert cost <= min_cost * size**2 * (1 + 1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_exact_matches_give_the_exact_matrix(seed: int) -> None:
    F, x0, x1 = unit_scene(seed)
    fitted, cost = refine_components(
        models(F, 4, 0.01, seed), components(x0, x1), torch.ones(1, 100, dtype=torch.float64), "huber",
        torch.tensor([0.1], dtype=torch.float64), 15,
    )  # fmt: skip
    assert bool((cost < 1e-28).all())
    # Rounding of 1e-16 times the condition of the scene (at most some 1e4)
    assert bool((distance(fitted, torch.from_numpy(F.reshape(9, 1, 1))) < 1e-11).all())


@pytest.mark.parametrize("loss", LOSSES)
def test_cost_never_rises(loss: str) -> None:
    F, x0, x1 = unit_scene(7, 90, noise=5e-3, outliers=40)
    F0 = torch.cat([models(F, 10, 0.05), models(F, 10, 1.0)], 2)
    weight = torch.from_numpy(np.random.default_rng(0).uniform(0, 1, (1, 90)))
    scale = torch.tensor([0.02], dtype=torch.float64)
    costs = [refine_components(F0, components(x0, x1), weight, loss, scale, i)[1] for i in range(8)]
    for before, after in itertools.pairwise(costs):
        assert bool((after <= before).all())
    assert bool((costs[-1] < costs[0])[:, :10].any())


def test_same_bits_in_any_batch_pool_and_padding() -> None:
    pairs = [unit_scene(i, 150, noise=3e-3, outliers=30) for i in range(5)]
    points = torch.cat([components(x0, x1) for _, x0, x1 in pairs], 1)
    F0 = torch.cat([models(F, 13, 0.02, i) for i, (F, _, _) in enumerate(pairs)], 1)
    weight = torch.from_numpy(np.random.default_rng(1).uniform(0, 1, (5, 150)))
    scale = torch.linspace(0.01, 0.03, 5, dtype=torch.float64)
    F, cost = refine_components(F0, points, weight, "cauchy", scale, 4)
    for i, j in ((0, 0), (3, 7), (4, 12)):
        single, its_cost = refine_components(
            F0[:, i : i + 1, j : j + 1], points[:, i : i + 1], weight[i : i + 1], "cauchy", scale[i : i + 1], 4
        )
        assert torch.equal(single[:, 0, 0], F[:, i, j])
        assert torch.equal(its_cost[0, 0], cost[i, j])
    padded = torch.nn.functional.pad(points, (0, 300)), torch.nn.functional.pad(weight, (0, 300))
    more, more_cost = refine_components(F0, *padded, "cauchy", scale, 4)
    assert torch.equal(more, F)
    assert torch.equal(more_cost, cost)


def test_masked_slots_and_neighbours_are_invisible() -> None:
    F, x0, x1 = (torch.from_numpy(v) for v in unit_scene(3, 90, noise=2e-3))
    x0, x1 = 400 * x0 + 300, 400 * x1 + 200
    F0 = refine(F, x0, x1, scale=5.0, iterations=2)
    expected = refine(F0, x0, x1, scale=2.0)
    where = torch.arange(90) * 2 + 11
    y0, y1 = torch.full((2, 201, 2), torch.nan, dtype=torch.float64)
    mask = torch.zeros(201, dtype=torch.bool)
    y0[where], y1[where], mask[where] = x0, x1, True
    assert torch.equal(refine(F0, y0, y1, mask=mask, scale=2.0), expected)
    bad = torch.full_like(y0, torch.inf)
    batch = refine(torch.stack([F0, F0]), torch.stack([bad, y0]), torch.stack([y1, y1]),
                   mask=torch.stack([mask, mask]), scale=2.0)  # fmt: skip
    assert torch.equal(batch[1], expected)
    pool = refine(torch.stack([F, F0, -F0]), x0, x1, scale=2.0)
    assert torch.equal(pool[1], expected)
    assert torch.equal(pool[2], -expected)


@pytest.mark.parametrize("loss", LOSSES)
def test_hopeless_problems_keep_their_model(loss: str) -> None:
    F, x0, x1 = unit_scene(1, 60, noise=1e-3)
    points = components(x0, x1).repeat(1, 5, 1)
    points[:, 1] = 0.0  # all matches coincide
    points[2:, 2] = points[:2, 2]  # identity
    points[1, 3], points[3, 3] = points[0, 3] * 0.5, points[2, 3] * 0.5 + 0.1  # lines
    weight = torch.ones(5, 60, dtype=torch.float64)
    weight[4] = 0
    F0 = models(F, 4, 0.01).repeat(1, 5, 1)
    F0[:, :, 1] = torch.nan
    F0[:, :, 2] = 0
    F0[:, :, 3] = torch.tensor([1.0, 2, 3, 2, 4, 6, 3, 6, 9], dtype=torch.float64)[:, None]  # rank 1
    scale = torch.full((5,), 0.01, dtype=torch.float64)
    fitted, cost = refine_components(F0, points, weight, loss, scale, 6)
    assert bool(torch.isfinite(fitted[:, :, 0]).all())
    assert bool(torch.isfinite(cost[:, 0]).all())
    assert bool(torch.isnan(fitted[:, :, 1]).all())
    assert bool(torch.isinf(cost[:, 1:3]).all())
    assert bool((fitted[:, :, 2] == 0).all())
    assert not bool(torch.isnan(cost).any())
    alone, _ = refine_components(F0[:, :1, :1], points[:, :1], weight[:1], loss, scale[:1], 6)
    assert torch.equal(alone[:, 0, 0], fitted[:, 0, 0])


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


def test_attached_step_is_finite_everywhere() -> None:
    F, a, b = unit_scene(2, 30, noise=1e-3)
    x0, x1 = torch.from_numpy(a).repeat(6, 1, 1), torch.from_numpy(b).repeat(6, 1, 1)
    x0[1] = torch.nan
    x0[2], x1[2] = 0.1, 0.2
    x1[3] = x0[3]
    x0[4, :, 1] = x0[4, :, 0]
    x1[4, :, 1] = x1[4, :, 0]
    Fs = torch.from_numpy(F).repeat(6, 1, 1)
    Fs[5] = torch.nan
    x0.requires_grad_()
    x1.requires_grad_()
    weight = torch.ones(6, 30, dtype=torch.float64, requires_grad=True)
    stepped = attached_step(Fs, x0, x1, weight, scale=1.0)
    gradients = torch.autograd.grad(stepped[:5].sum(), (x0, x1, weight))
    assert all(bool(torch.isfinite(g).all()) for g in gradients)
    assert bool(torch.isfinite(stepped[:5]).all())
    alone = attached_step(Fs[0], x0[0], x1[0], weight[0], scale=1.0)
    assert torch.equal(alone, stepped[0])
    assert bool((torch.autograd.grad(attached_step(Fs, x0, x1, weight)[5].sum(), x0)[0][:5] == 0).all())
