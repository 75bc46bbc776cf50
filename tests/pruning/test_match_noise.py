"""The noise of matches, and what estimators make of it."""

import math

import numpy as np
import pytest
import torch

from fmtorch import find_fundamental, metrics, presets
from fmtorch.pruning import match_noise
from tests.geometry.scenes import scene as matched_scene
from tests.laws import scene

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
    inputs = [x[:1, :8].clone().requires_grad_() for x in (lafs0, lafs1, ratio, prior)]
    assert torch.autograd.gradcheck(lambda *x: match_noise(*x, **NUMBERS), inputs)


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


def _noisy_pair(seed: int) -> tuple[torch.Tensor, ...]:
    """Points of two views whose noise differs tenfold from match to match, the true F, and that noise."""
    rng, exact = np.random.default_rng(seed), matched_scene(120, seed)
    noise = torch.from_numpy(np.where(rng.random(120) < 0.5, 0.3, 3.0))
    errors = torch.from_numpy(rng.normal(size=(2, 120, 2))) * 0.3 * noise[:, None]
    return exact.x0 + errors[0], exact.x1 + errors[1], exact.F, noise


def test_known_noise_makes_estimates_more_exact() -> None:
    size = torch.tensor([[800, 1000]])
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
