"""Candidates of plausible cameras: drawn, searched, chosen, fitted with their prior, given up where they are wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fmtorch import presets
from fmtorch.core.types import Correspondences, collate
from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.final_fits import PRIOR_CONFLICT_GAIN
from fmtorch.estimators.focal.cameras import CentredPairs, TwoCameras
from fmtorch.estimators.focal.fit import fit_focal, truncated_posterior
from fmtorch.estimators.focal.hypotheses import FocalSamples
from fmtorch.estimators.focal.posterior import refine_with_prior
from fmtorch.estimators.focal.prior import draw_focal_lengths
from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs
from fmtorch.geometry import sampson
from fmtorch.geometry.refine import refine_components
from fmtorch.metrics import nsgd
from tests.reference import focal as reference

SIZE = (600, 800)  # (h, w)


def _pair(
    seed: int,
    sizes: tuple[tuple[int, int], tuple[int, int]] = (SIZE, SIZE),
    focal: tuple[float, float] = (1.0, 1.0),
    count: int = 150,
    noise: float = 0.5,
    outliers: float = 0.3,
    relief: float = 1.0,
    shift: float = 0.0,
) -> tuple[Correspondences, torch.Tensor]:
    """Matches of a scene of some relief (0: a plane) and the true F; shift: of the principal points, px."""
    rng = np.random.default_rng(seed)
    X = np.concatenate([rng.uniform(-1.2, 1.2, (count, 2)), rng.uniform(-1, 1, (count, 1)) * relief + 5], 1)
    R = Rotation.from_rotvec(np.array([0.02, 0.35, 0.05]) + rng.uniform(-0.05, 0.05, 3)).as_matrix()
    t = np.array([-1.5, 0.1, 0.3])
    K = [reference.calibration(f, s) for f, s in zip(focal, sizes, strict=True)]
    for k in K:
        k[:2, 2] += shift
    x0, x1 = ((Y / Y[:, 2:]) @ k.T for Y, k in ((X, K[0]), (X @ R.T + t, K[1])))
    x0, x1 = (x[:, :2] + rng.normal(0, noise, (count, 2)) for x in (x0, x1))
    wrong = rng.random(count) < outliers
    x1[wrong] = rng.uniform([0, 0], sizes[1][::-1], (int(wrong.sum()), 2))
    c = Correspondences(
        torch.from_numpy(x0)[None], torch.from_numpy(x1)[None], torch.ones(1, count, dtype=torch.bool),
        size0=torch.tensor([sizes[0]]), size1=torch.tensor([sizes[1]]), key=torch.tensor([seed + 1]),
    )  # fmt: skip
    F = np.linalg.inv(K[1]).T @ reference.cross_matrix(t) @ R @ np.linalg.inv(K[0])
    return c, torch.from_numpy(F / np.linalg.norm(F))


def _normalized(c: Correspondences) -> NormalizedPairs:
    (normalized,), reasons = normalized_pairs(c, 0, 7)
    assert not reasons
    return normalized


def _error(F: torch.Tensor, c: Correspondences, truth: torch.Tensor) -> float:
    return float(nsgd(truth[None], F[None], c.size0, c.size1, key=c.keys)[0])


def test_drawn_focal_lengths_follow_their_prior() -> None:
    for sizes in ((SIZE, SIZE), (SIZE, (800, 600))):
        normalized = _normalized(_pair(0, sizes)[0])
        focal = draw_focal_lengths(normalized, CentredPairs(normalized).same_size, 0, 4000)
        mean, difference = focal.mean(0)[0], (focal[0] - focal[1])[0]
        assert float(mean.mean()) == pytest.approx(math.log(1.2), abs=0.03)
        assert float(mean.std()) == pytest.approx(0.4, abs=0.02)
        equal = float((difference == 0).double().mean())
        assert equal == pytest.approx(0.7 if sizes[0] == sizes[1] else 0.0, abs=0.03)
        assert float(difference[difference != 0].std()) == pytest.approx(0.5, abs=0.04)


def test_hypotheses_pass_through_their_five_matches() -> None:
    pairs = [_pair(s, noise=0.0, outliers=0.0) for s in (0, 1)]
    normalized = _normalized(collate([c for c, _ in pairs]))
    index = torch.stack([torch.stack([torch.randperm(150)[:40] for _ in range(5)]) for _ in range(2)], 1)
    made = FocalSamples(lambda *_: index)(normalized, 7, 40)
    F, valid = made.F, made.valid
    assert int(valid.sum()) > 100
    count = valid.sum(1)
    assert bool((valid == (torch.arange(valid.shape[1]) < count[:, None])).all())
    models = F.permute(1, 2, 0).reshape(2, -1, 3, 3).double()
    x0, x1 = normalized.points[:2].permute(1, 2, 0), normalized.points[2:].permute(1, 2, 0)
    for p in range(2):
        at = (made.draw[p, : count[p]] - 7)[None].expand(5, -1)
        own = index[:, p].gather(1, at)  # the five matches of each model
        r = torch.stack([sampson(M[None], x0[p : p + 1], x1[p : p + 1])[0] for M in models[p, : count[p]]])
        # To the rounding of float32.
        assert float(r.gather(1, own.T).amax(1).median()) < 1e-5


def test_a_plane_does_not_deceive_where_cameras_are_plausible() -> None:
    """Seven matches near a plane leave F open; five with a focal length do not."""
    errors = {samples: [] for samples in (0, 250)}  # type: dict[int, list[float]]
    for seed in range(8):
        c, truth = _pair(seed, relief=0.02, outliers=0.4, focal=(0.9, 0.9))
        for samples, found in errors.items():
            estimate = presets.build("estimator", "fmtorch", focal={"samples": samples})(c, 0)
            found.append(_error(estimate.F[0], c, truth))
    assert np.median(errors[250]) < 0.02
    assert np.median(errors[250]) < 0.5 * np.median(errors[0])


def test_other_cameras_fall_back_to_the_fit_without_prior() -> None:
    """The principal point far off the centre: the matches contradict the prior, and the estimate is that without."""
    c, truth = _pair(3, shift=250.0, noise=0.1, outliers=0.1, count=400)
    estimate = presets.build("estimator", "fmtorch")(c, 0)
    assert _error(estimate.F[0], c, truth) < 0.01


@pytest.mark.parametrize("focal", [(1.1, 1.1), (1.1, 0.8), (0.45, 0.45)])
def test_fit_reaches_the_optimum_and_tells_what_the_prior_costs(focal: tuple[float, float]) -> None:
    noise = 0.5
    c, truth = _pair(5, outliers=0.0, noise=noise, focal=focal)
    normalized = _normalized(c)
    unit = float(normalized.pixels_per_unit[0])
    A = [np.array([[unit, 0, x], [0, unit, y], [0, 0, 1]]) for x, y in normalized.centre[0].reshape(2, 2).tolist()]
    start = torch.from_numpy(A[1].T @ truth.numpy() @ A[0]).reshape(9, 1, 1)
    *_, cameras = refine_with_prior(start / start.norm(), normalized)
    wide, sigma = torch.tensor([50.0], dtype=torch.float64), torch.tensor([noise], dtype=torch.float64)
    fit = fit_focal(TwoCameras(cameras.axes[..., 0], cameras.focal[..., 0]), normalized, wide, sigma, 50, -math.inf)
    posterior = truncated_posterior(normalized, CentredPairs(normalized), wide, sigma, None)
    state = posterior.evaluate((fit.cameras.axes[..., None], fit.cameras.focal[..., None]), True)
    assert float(state.gradient.abs().max()) < 1e-6 * float(state.hessian.abs().max())
    # What a fit without prior gains, in logarithms of the likelihood.
    F = fit.F.flatten(1).T[..., None].contiguous()
    costs = [
        float(refine_components(F, normalized.points, normalized.weight, "truncated", wide / unit, steps)[1])
        for steps in (0, 50)
    ]
    gained = (costs[0] - costs[1]) * (unit / noise) ** 2 / 2
    assert 0 < gained < PRIOR_CONFLICT_GAIN
    assert float(fit.gain) == pytest.approx(gained, rel=0.05)


@pytest.mark.parametrize("same", [True, False])
def test_gradients_are_those_of_the_optimum(same: bool) -> None:
    """Moving a match by a little moves the estimate as the gradient says."""
    sizes = (SIZE, SIZE if same else (800, 600))
    c, _ = _pair(7, sizes, outliers=0.0, noise=0.1, focal=(1.0, 1.0 if same else 1.1), count=60)
    estimator = HypothesizeAndVerify(
        hypotheses=500, score="saturated", pool=8, refine={"kernel": "truncated"}, select={"scale": 0.3},
        focal={"samples": 100, "pool": 8}, final="adaptive", inlier_threshold=3.0,
    )  # fmt: skip
    x0 = c.x0.clone().requires_grad_(True)
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(3, 3)))

    def value(x: torch.Tensor) -> torch.Tensor:
        F = estimator(c.replace(x0=x), 0).F[0]
        F = F / F.norm()
        D = torch.diag(torch.tensor([400.0, 300, 1], dtype=F.dtype))
        G = D @ F @ D
        return (weights * (G / G.norm()) * G.flatten()[G.detach().abs().argmax()].sign()).sum()

    (gradient,) = torch.autograd.grad(value(x0), x0)
    assert bool(torch.isfinite(gradient).all())
    direction = torch.from_numpy(np.random.default_rng(1).normal(size=x0.shape))
    step = 1e-3
    with torch.no_grad():
        numeric = float(value(c.x0 + step * direction) - value(c.x0 - step * direction)) / (2 * step)
    analytic = float((gradient * direction).sum())
    # Gauss and Newton's Hessian leaves out the curvature of the residuals: some percent at this noise.
    assert analytic == pytest.approx(numeric, rel=0.15, abs=1e-6)


def test_the_stopping_rule_spares_the_second_search() -> None:
    easy, _ = _pair(1, outliers=0.05, count=300)
    settled = presets.build("estimator", "fmtorch")(easy, 0)
    assert int(settled.draws[0]) == 3 * 250
    mixed, _ = _pair(1, (SIZE, (800, 600)), outliers=0.75, count=300)
    assert int(presets.build("estimator", "fmtorch")(mixed, 0).draws[0]) > 3 * 250


def test_unknown_sizes_are_searched_without_assumptions() -> None:
    c, truth = _pair(2, outliers=0.2, count=300)
    bare = c.replace(size0=None, size1=None)
    estimate = presets.build("estimator", "fmtorch")(bare, 0)
    assert bool(estimate.ok[0])
    assert torch.equal(estimate.F, presets.build("estimator", "fmtorch", focal=None)(bare, 0).F)
    assert _error(estimate.F[0], c, truth) < 0.05


def test_an_exact_plane_has_a_solution_where_cameras_are_plausible() -> None:
    """Any seven of its matches leave F open, so that there is no sample of seven; five and a focal length suffice."""
    c, truth = _pair(4, relief=0.0, noise=0.0, outliers=0.0)
    estimate = presets.build("estimator", "fmtorch")(c, 0)
    assert bool(estimate.ok[0])
    assert float(sampson(estimate.F, c.x0, c.x1).max()) < 1e-3
    assert int(estimate.inliers.sum()) == 150
    assert _error(estimate.F[0], c, truth) < 0.05


def test_a_fit_goes_on_after_a_rejected_step() -> None:
    """The first step from this start raises the cost; shorter ones gain more than what ends the fit."""
    c, truth = _pair(2, noise=0.5, outliers=0.3)
    normalized = _normalized(c)
    unit = float(normalized.pixels_per_unit[0])
    A = [np.array([[unit, 0, x], [0, unit, y], [0, 0, 1]]) for x, y in normalized.centre[0].reshape(2, 2).tolist()]
    model = torch.from_numpy(A[1].T @ truth.numpy() @ A[0]).reshape(9, 1, 1)
    *_, start = refine_with_prior(model / model.norm(), normalized)
    ratio = torch.tensor([0.1, -0.1], dtype=torch.float64)[:, None, None]
    start = TwoCameras(start.axes, start.focal + ratio)
    px = torch.tensor([1.0], dtype=torch.float64)
    posterior = truncated_posterior(normalized, CentredPairs(normalized), px, px / 2, None)
    before = posterior.evaluate((start.axes, start.focal), True)
    trial = posterior.evaluate(posterior.step(before, posterior.begin(before)[0]), False)
    assert float(trial.cost) > float(before.cost)
    fit = fit_focal(TwoCameras(start.axes[..., 0], start.focal[..., 0]), normalized, px, px / 2, 30, 0.05)
    after = posterior.evaluate((fit.cameras.axes[..., None], fit.cameras.focal[..., None]), False)
    assert float(after.cost) < float(before.cost) - 0.05
