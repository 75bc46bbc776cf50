"""The focal choice reaches the optimum that SciPy finds, and steps back where its assumption fails."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fmtorch.core.types import Correspondences, collate
from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.focal.cameras import bougnoux
from fmtorch.estimators.focal.posterior import LOSS_SCALE_PX, refine_with_prior
from fmtorch.estimators.focal.selection import FocalSelection
from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs
from fmtorch.estimators.saturated_gains import SaturatedGains
from fmtorch.geometry.arithmetic import unit
from fmtorch.geometry.rank2_manifold import start
from fmtorch.geometry.refine import refine_components
from tests.conftest import oracle
from tests.laws import scenes
from tests.reference import focal as reference

SIZE0, SIZE1 = (640, 960), (1000, 700)  # (h, w)


def _pair(
    seed: int, focal: tuple[float, float] = (1.1, 1.4), count: int = 200, noise: float = 0.2, outliers: float = 0.2
) -> tuple[Correspondences, np.ndarray]:
    """A pair of whole photographs and its true parameters: rotation vector, translation, log focal lengths."""
    rng = np.random.default_rng(seed)
    X = np.concatenate([rng.uniform(-1, 1, (count, 2)), rng.uniform(4, 9, (count, 1))], 1)
    rotation, translation = rng.uniform(-0.2, 0.2, 3), rng.uniform(-1, 1, 3)
    translation /= np.linalg.norm(translation)
    parameters = np.concatenate([rotation, translation, np.log(focal)])
    moved = X @ Rotation.from_rotvec(rotation).as_matrix().T + translation
    x0, x1 = (
        (Y / Y[:, 2:]) @ reference.calibration(f, size).T
        for Y, f, size in ((X, focal[0], SIZE0), (moved, focal[1], SIZE1))
    )
    x0, x1 = (x[:, :2] + rng.normal(0, noise, (count, 2)) for x in (x0, x1))
    wrong = rng.random(count) < outliers
    x1[wrong] = rng.uniform([0, 0], SIZE1[::-1], (int(wrong.sum()), 2))
    prior = np.where(wrong, rng.uniform(0.1, 0.5, count), rng.uniform(0.5, 1, count))
    c = Correspondences(
        torch.from_numpy(x0)[None], torch.from_numpy(x1)[None], torch.ones(1, count, dtype=torch.bool),
        prior=torch.from_numpy(prior)[None], size0=torch.tensor([SIZE0]), size1=torch.tensor([SIZE1]),
        key=torch.tensor([seed + 1]),
    )  # fmt: skip
    return c, parameters


def _pairs(c: Correspondences) -> NormalizedPairs:
    (pairs,), reasons = normalized_pairs(c, 0, 7)
    assert not reasons
    return pairs


def _normalised(F: np.ndarray, pairs: NormalizedPairs) -> torch.Tensor:
    """A matrix in pixels as one candidate (9, 1, 1) of the first pair."""
    unit = float(pairs.pixels_per_unit[0])
    A = [np.array([[unit, 0, x], [0, unit, y], [0, 0, 1]]) for x, y in pairs.centre[0].reshape(2, 2).tolist()]
    G = A[1].T @ F @ A[0]
    return torch.from_numpy(G / np.linalg.norm(G)).reshape(9, 1, 1)


def _pixels(F: torch.Tensor, pairs: NormalizedPairs) -> np.ndarray:
    return pairs.to_pixels(F[..., 0].T.reshape(-1, 3, 3))[0].numpy()


def test_bougnoux_recovers_the_focal_lengths() -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        focal = rng.uniform(0.5, 3, 2)
        K0, K1 = (np.diag([f, f, 1]) for f in focal)
        R = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
        F = np.linalg.inv(K1).T @ reference.cross_matrix(rng.normal(size=3)) @ R @ np.linalg.inv(K0)
        squared = bougnoux(*start(torch.from_numpy(F / np.linalg.norm(F)).reshape(9, 1, 1))).ravel().numpy()
        # Ill-conditioned where the axes almost meet; none of these ten pairs is within 1e-6 of it.
        np.testing.assert_allclose(squared, focal**2, rtol=1e-8)


@pytest.mark.parametrize("seed", range(6))
def test_same_cost_as_scipy(seed: int) -> None:
    c, truth = _pair(seed)
    pairs = _pairs(c)
    x0, x1, weight = c.x0[0].numpy(), c.x1[0].numpy(), c.prior[0].numpy()  # type: ignore[index]
    _, expected = reference.optimum(truth, x0, x1, weight, LOSS_SCALE_PX, SIZE0, SIZE1)
    F = _normalised(reference.fundamental(truth, SIZE0, SIZE1), pairs)
    # From the unconstrained optimum, as in the engine: focal lengths there are off, often implausible.
    F, _ = refine_components(F, pairs.points, pairs.prior, "truncated", LOSS_SCALE_PX / pairs.pixels_per_unit, 10)  # type: ignore[arg-type]
    models, prior, *_ = refine_with_prior(F, pairs, iterations=50)
    found = _pixels(models, pairs)
    r = reference.sampson(found, x0, x1)
    data = (weight * reference.loss(r, LOSS_SCALE_PX)).sum() / (2 * 0.3**2)
    # The loss has local minima, but on these pairs both end in the same one, where the cost is flat: an error of the
    # parameters enters squared, and SciPy stops within 1e-7 of the least cost.
    assert data + float(prior) <= expected * (1 + 1e-9)
    assert data + float(prior) == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("name", ["000", "010", "020"])
def test_scipy_finds_nothing_better_nearby_on_real_pairs(name: str) -> None:
    data = oracle("robust.npz")
    x0, x1 = data[f"{name}.X1"].astype(np.float64), data[f"{name}.X2"].astype(np.float64)
    sizes = [(int(h), int(w)) for h, w in (data[f"{name}.size1"], data[f"{name}.size2"])]
    c = Correspondences(
        torch.from_numpy(x0)[None], torch.from_numpy(x1)[None], torch.ones(1, len(x0), dtype=torch.bool),
        size0=torch.tensor(sizes[:1]), size1=torch.tensor(sizes[1:]),
    )  # fmt: skip
    pairs, weight = _pairs(c), np.ones(len(x0))
    models, prior, *_ = refine_with_prior(_normalised(data[f"{name}.F_gt"], pairs), pairs, iterations=50)
    found = _pixels(models, pairs)
    parameters = reference.parameters_of(found, *sizes)
    same = sizes[0] == sizes[1]
    expected = reference.prior_cost(parameters[6], parameters[7], same)  # by way of F and Bougnoux
    assert float(prior) == pytest.approx(expected, rel=1e-4)
    cost = reference.cost(found, parameters[6:], x0, x1, weight, LOSS_SCALE_PX, same)
    _, least = reference.optimum(parameters, x0, x1, weight, LOSS_SCALE_PX, *sizes)
    assert cost <= least * (1 + 1e-6)


def test_no_noise_no_change() -> None:
    c, truth = _pair(1, focal=(1.2, 1.2), noise=0.0, outliers=0.0)
    pairs = _pairs(c)
    F = _normalised(reference.fundamental(truth, SIZE0, SIZE1), pairs)
    models, prior, *_ = refine_with_prior(F, pairs)
    # Residuals are below 1e-9 px here, so the prior's pull of a focal length of 1.2 is of the same order.
    assert float((models * F).sum().abs()) == pytest.approx(1, abs=1e-12)
    assert float(prior) < 1e-12


def test_prior_decides_between_models_that_explain_the_matches_alike() -> None:
    c, truth = _pair(2, focal=(1.2, 1.2), outliers=0.0)
    pairs = _pairs(c)
    strange = truth + np.array([0, 0, 0, 0, 0, 0, np.log(3), -np.log(3)])
    pool = torch.cat([_normalised(reference.fundamental(p, SIZE0, SIZE1), pairs) for p in (strange, truth)], 2)
    _, prior, *_ = refine_with_prior(pool, pairs, iterations=0)
    assert float(prior[0, 0]) == pytest.approx(reference.prior_cost(*strange[6:]), rel=1e-9)
    assert float(prior[0, 1]) == pytest.approx(0, abs=1e-9)


def test_a_crop_keeps_the_model_without_prior() -> None:
    c, truth = _pair(3, outliers=0.0, noise=0.1)
    shifted = c.replace(x0=c.x0 + 4000, size0=torch.tensor([[640, 960]]))  # the principal point is far outside
    pairs = _pairs(shifted)
    K0, K1 = reference.calibration(1.1, SIZE0), reference.calibration(1.4, SIZE1)
    K0[:2, 2] += 4000
    R = Rotation.from_rotvec(truth[:3]).as_matrix()
    F = _normalised(np.linalg.inv(K1).T @ reference.cross_matrix(truth[3:6]) @ R @ np.linalg.inv(K0), pairs)
    chosen = FocalSelection(SaturatedGains(0.3))(F, torch.ones(1, 1, dtype=torch.bool), pairs, pairs)[0]
    assert torch.equal(chosen, F[..., 0])


def test_unknown_sizes_give_the_saturated_choice() -> None:
    c = scenes().replace(size0=None, size1=None)
    options = {"hypotheses": 200, "pool": 8, "refine": {"kernel": "truncated"}, "select": {}, "final": "none"}
    focal = HypothesizeAndVerify(focal={}, **options)(c)  # type: ignore[arg-type]
    saturated = HypothesizeAndVerify(**options)(c)  # type: ignore[arg-type]
    assert torch.equal(focal.F, saturated.F)


def test_the_prior_is_asked_only_where_good_candidates_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    c, truth = _pair(4, outliers=0.1)
    pairs, valid = _pairs(c), torch.ones(1, 2, dtype=torch.bool)
    turned = truth + np.array([0.3, 0, 0, 0, 0, 0, 0, 0])
    right, other = (unit(_normalised(reference.fundamental(p, SIZE0, SIZE1), pairs)) for p in (truth, turned))
    same, different = torch.cat([right, right], 2), torch.cat([right, other], 2)
    monkeypatch.setattr("fmtorch.estimators.focal.selection.RIVAL_GAIN_SHARE", 0.0)  # every candidate is a good one
    assert torch.equal(FocalSelection(SaturatedGains(0.3))(same, valid, pairs, pairs)[0], right[..., 0])
    refined, *_ = refine_with_prior(different, pairs)
    chosen = FocalSelection(SaturatedGains(0.3))(different, valid, pairs, pairs)[0]
    assert any(torch.equal(chosen, refined[..., k]) for k in (0, 1))
    assert not torch.equal(chosen, right[..., 0])
    monkeypatch.setattr("fmtorch.estimators.focal.selection.RIVAL_GAIN_SHARE", 2.0)  # none is
    assert torch.equal(FocalSelection(SaturatedGains(0.3))(different, valid, pairs, pairs)[0], right[..., 0])


def test_support_behind_a_camera_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    c, truth = _pair(4, outliers=0.1)
    pairs, valid = _pairs(c), torch.ones(1, 2, dtype=torch.bool)
    turned = truth + np.array([5e-4, 0, 0, 0, 0, 0, 0, 0])  # half a pixel
    right, other = (unit(_normalised(reference.fundamental(p, SIZE0, SIZE1), pairs)) for p in (truth, turned))
    both = torch.cat([right, other], 2)
    refined, _, front, _ = refine_with_prior(both, pairs, iterations=0)
    assert float(front[0, 0]) > 0.9  # the scene is before both cameras; some wrong matches agree by chance
    monkeypatch.setattr("fmtorch.estimators.focal.selection.RIVAL_GAIN_SHARE", 0.0)  # every candidate is a good one
    monkeypatch.setattr("fmtorch.estimators.focal.selection.SAME_MODEL", 0.0)  # and another model
    monkeypatch.setattr("fmtorch.estimators.focal.selection.MIN_GAIN_SHARE", 0.0)
    for share, best in ((1.0, 0), (0.01, 1)):
        shares = torch.tensor([[share, 1.0]], dtype=torch.float64)
        monkeypatch.setattr("fmtorch.estimators.focal.posterior.share_in_front", lambda *_, shares=shares: shares)
        chosen = FocalSelection(SaturatedGains(0.3), iterations=0)(both, valid, pairs, pairs)[0]
        assert torch.equal(chosen, refined[..., best])


def test_models_that_are_not_finite_harm_no_other() -> None:
    pair = collate([_pair(seed)[0] for seed in (4, 5)])
    pairs = _pairs(pair)
    good = torch.cat([_normalised(reference.fundamental(_pair(s)[1], SIZE0, SIZE1), pairs) for s in (4, 5)], 1)
    bad = torch.cat([torch.full_like(good, torch.nan), torch.zeros_like(good), good], 2)
    alone, *_ = refine_with_prior(good, pairs)
    models, prior, *_ = refine_with_prior(bad, pairs)
    assert torch.equal(models[:, :, 2:], alone)
    assert bool(torch.isinf(prior[:, :2]).all())
    chosen = FocalSelection(SaturatedGains(0.3))(bad, torch.tensor([[False, False, True]] * 2), pairs, pairs)[0]
    assert bool(torch.isfinite(chosen).all())
