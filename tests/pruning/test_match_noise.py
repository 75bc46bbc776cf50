"""The noise of matches, and what estimators make of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from fmtorch import find_fundamental, metrics, presets
from fmtorch.core.types import collate
from fmtorch.geometry import sampson
from fmtorch.geometry.refine import refine_components
from fmtorch.pruning import match_noise
from tests.laws import quick, scene

NUMBERS = {"usual": 4.06, "radius": 15.0, "slope": 0.65}


def test_is_its_formula() -> None:
    rng = np.random.default_rng(0)
    lafs0, lafs1 = (torch.from_numpy(rng.normal(size=(2, 50, 2, 3)) * 20) for _ in range(2))
    ratio, prior = (torch.from_numpy(rng.random((2, 50))) for _ in range(2))
    noise = match_noise(lafs0, lafs1, ratio, prior, **NUMBERS)
    for b in range(2):
        for i in range(50):
            scales = [math.sqrt(abs(np.linalg.det(lafs[b, i, :, :2].numpy()))) for lafs in (lafs0, lafs1)]
            r, P = float(ratio[b, i]), max(float(prior[b, i]), 0.02)
            expected = (1 + max(scales) / 15) * (1 + 0.65 * r) ** 2 * P**-0.25 / 4.06
            assert float(noise[b, i]) == pytest.approx(expected, rel=1e-9)


def test_matches_without_frames_are_left_as_they_are_and_what_cannot_be_told_is_usual() -> None:
    stage = presets.build("pruner", "match_noise")
    c = scene(0, 50)
    assert stage(c.replace(lafs0=None, lafs1=None)).noise is None
    lafs = c.lafs0.clone()
    lafs[:, 3] = float("nan")
    noise = stage(c.replace(lafs0=lafs)).noise
    assert float(noise[0, 3]) == 1
    assert bool(torch.isfinite(noise).all())
    alone = stage(c.replace(ratio=None, prior=None)).noise
    assert bool((alone[c.mask] > 0).all())


def test_gradients_are_finite_beside_padding_and_what_is_no_frame() -> None:
    c = scene(0, 50)
    lafs = c.lafs0.clone()
    lafs[:, 3], lafs[:, 4] = float("nan"), 0.0
    lafs.requires_grad_()
    prior = torch.rand(c.mask.shape, requires_grad=True)
    mask = c.mask.clone()
    mask[:, 5:9] = False
    noise = presets.build("pruner", "match_noise")(c.replace(lafs0=lafs, mask=mask, prior=prior)).noise
    noise.sum().backward()
    assert bool(torch.isfinite(lafs.grad).all())
    assert bool(torch.isfinite(prior.grad).all())
    assert bool((prior.grad[mask] != 0).any())


def test_noise_travels_with_its_matches() -> None:
    c = presets.build("pruner", "match_noise")(scene(0, 50))
    kept = torch.zeros_like(c.mask)
    kept[:, 10:30] = True
    short = c.keep(kept).compact()
    assert torch.equal(short.noise[0, :20], c.noise[0, 10:30])
    assert torch.equal(collate([short, c]).noise[1], c.noise[0])


@pytest.mark.parametrize("kernel", ["truncated", "geman_mcclure", "cauchy"])
def test_a_scale_for_each_match_that_is_the_same_is_one_scale(kernel: str) -> None:
    F, points, weight = _fit()
    shared_scale = torch.full((1, 1), 1e-3, dtype=torch.float64)
    single = refine_components(F, points, weight, kernel, shared_scale, 5)
    each = refine_components(F, points, weight, kernel, shared_scale.expand(1, points.shape[2]), 5)
    for a, b in zip(single, each, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("kernel", ["truncated", "geman_mcclure", "cauchy"])
def test_scale_and_weight_by_noise_are_the_robust_cost_of_residuals_in_units_of_noise(kernel: str) -> None:
    F, points, weight = _fit()
    n = points.shape[2]
    noise = torch.linspace(0.5, 3, n, dtype=torch.float64)[None]
    _, cost = refine_components(F, points, weight / noise**2, kernel, 1e-3 * noise, 0)
    model = F[:, 0, 0].reshape(3, 3)
    r2 = (sampson(model[None], points[:2].permute(1, 2, 0), points[2:].permute(1, 2, 0)) / noise).square()
    loss = {
        "truncated": torch.minimum(r2, torch.full_like(r2, 1e-6)),
        "geman_mcclure": r2 * 1e-6 / (1e-6 + r2),
        "cauchy": 1e-6 * torch.log1p(r2 / 1e-6),
    }[kernel]
    assert float(cost) == pytest.approx(float((weight * loss).sum()), rel=1e-6)


def _fit() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(1)
    n = 100
    points = torch.from_numpy(rng.uniform(-1, 1, (4, 1, n)))
    weight = torch.from_numpy(rng.random((1, n)))
    U, s, V = np.linalg.svd(rng.normal(size=(3, 3)))
    F = (U * [s[0], s[1], 0]) @ V
    return torch.from_numpy(F / np.linalg.norm(F)).reshape(9, 1, 1), points, weight


@pytest.mark.parametrize("name", ["fmtorch", "fmtorch_fast", "gc_ransac"])
def test_estimators_take_it_into_account(name: str) -> None:
    estimator, stage = quick(name, 60, 30), presets.build("pruner", "match_noise")
    c = stage(collate([scene(i, 150 + 40 * i) for i in range(4)]))
    assert not torch.equal(estimator(c, 5).F, estimator(c.replace(noise=None), 5).F)


def _noisy_pair(seed: int) -> tuple[torch.Tensor, ...]:
    """Points of two views whose noise differs tenfold from match to match, the true F, and that noise."""
    rng = np.random.default_rng(seed)
    X = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (120, 3))
    K = np.array([[800, 0, 399.5], [0, 800, 299.5], [0, 0, 1.0]])
    angle = 0.15
    R = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    t = np.array([-1.0, 0.1, 0.2])
    project = [(K @ Y.T).T for Y in (X, X @ R.T + t)]
    noise = np.where(rng.random(120) < 0.5, 0.3, 3.0)
    x0, x1 = (p[:, :2] / p[:, 2:] + rng.normal(size=(120, 2)) * 0.3 * noise[:, None] for p in project)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    F = np.linalg.inv(K).T @ cross @ R @ np.linalg.inv(K)
    return tuple(torch.from_numpy(v) for v in (x0, x1, F, noise))


def test_known_noise_makes_estimates_more_exact() -> None:
    size = torch.tensor([[600, 800]])
    errors = []
    for seed in range(12):
        x0, x1, F, noise = _noisy_pair(seed)
        row = []
        for given_noise in (None, noise):
            estimate = find_fundamental(x0, x1, noise=given_noise)  # with sizes, what is known of cameras helps both
            assert bool(estimate.ok[0])
            row.append(float(metrics.nsgd(F[None], estimate.F, size, size)))
        errors.append(row)
    without, with_noise = np.median(errors, 0)
    assert with_noise < 0.6 * without


def test_noise_out_of_bounds_is_survived() -> None:
    x0, x1, _, noise = _noisy_pair(0)
    noise = noise.clone()
    noise[:3] = torch.tensor([1e-30, 1e30, float("inf")])
    estimate = find_fundamental(x0, x1, noise=noise)
    assert bool(estimate.ok[0])
    assert bool(torch.isfinite(estimate.F).all())


def test_gradients_reach_the_noise() -> None:
    x0, x1, _, noise = _noisy_pair(0)
    noise = noise.clone().requires_grad_()
    estimate = find_fundamental(x0, x1, noise=noise)
    estimate.F.abs().sum().backward()
    assert noise.grad is not None
    assert bool(torch.isfinite(noise.grad).all())
    assert bool((noise.grad != 0).any())
