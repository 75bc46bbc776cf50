"""Scores equal their definitions and do not depend on tiles."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fmtorch.estimators.pairs import normalized_pairs
from fmtorch.estimators.saturated_gains import GRID, SaturatedGains
from fmtorch.estimators.scores import (
    GEMAN_MCCLURE_REACH,
    GemanMcClure,
    InlierCount,
    Median,
    SigmaConsensus,
    TruncatedSquares,
    score_models,
)
from scipy import integrate

from fmtorch.estimators import scores
from fmtorch.geometry.arithmetic import exact_sum
from fmtorch.geometry.sigma_consensus import QUANTILE
from tests.laws import scene
from tests.reference import ransac as reference

SCORES = [
    InlierCount(2.0),
    TruncatedSquares(2.0),
    TruncatedSquares(2.0, prior_weighted=True),
    GemanMcClure(2.0),
    GemanMcClure(2.0, prior_weighted=True),
    SaturatedGains(2.0, prior_weighted=False),
    SaturatedGains(2.0),
    Median(),
]
NAMES = [
    "count",
    "msac",
    "prior_msac",
    "geman_mcclure",
    "prior_geman_mcclure",
    "saturated",
    "prior_saturated",
    "median",
]


def _models(pairs: object, count: int = 40) -> torch.Tensor:
    return (
        torch.randn(9, 1, count, generator=torch.Generator().manual_seed(0)) * torch.logspace(-2, 0, 9)[:, None, None]
    )


@pytest.mark.parametrize("score", SCORES, ids=NAMES)
def test_scores_equal_their_definitions(score: scores.Score) -> None:
    pairs = normalized_pairs(scene(0, 60), 0, 8)[0][0]
    F = _models(pairs)
    batched = score_models(score, F, pairs)[0].numpy()
    points = pairs.points[:, 0, :60].float().double().numpy()
    prior = pairs.prior[0, :60].numpy() if pairs.prior is not None else None
    for m in range(F.shape[2]):
        model = F[:, 0, m].double().numpy().reshape(3, 3)
        residual = np.array([reference.sampson(model, points[:2, n], points[2:, n]) for n in range(60)])
        pixels = residual * float(pairs.pixels_per_unit[0])
        if isinstance(score, InlierCount):
            border = np.abs(pixels - 2.0) < 1e-3  # float32 residuals this close to the threshold may fall either way
            assert abs(batched[m] - (pixels <= 2.0).sum()) <= border.sum()
        elif isinstance(score, Median):
            # float32: relative error of a residual about 1e-7 times the cancellation in x1^T F x0
            np.testing.assert_allclose(-batched[m], reference.lower_median(residual**2), rtol=1e-3, atol=1e-12)
        elif isinstance(score, SaturatedGains):
            weights = prior if score.prior_weighted and prior is not None else np.ones(60)
            expected = reference.saturated(pixels, points, 2.0, GEMAN_MCCLURE_REACH, GRID, weights)
            double = score_models(score, F[..., m : m + 1].double(), pairs)
            # A gain just below half a rounding step counts nothing, and its root is missed: 2^-10.5, 2^-5.5 in float32.
            assert abs(float(double) - expected) <= 2.0**-10.5
            assert abs(batched[m] - expected) <= 2.0**-5.5
        elif isinstance(score, GemanMcClure):
            weights = prior if score.prior_weighted else None
            expected = reference.geman_mcclure(pixels, 2.0, GEMAN_MCCLURE_REACH, weights)
            assert abs(batched[m] - expected) <= 60 * 2.0**-11 + 1e-3
        else:
            expected = reference.msac(pixels, 2.0, prior if score.prior_weighted else None)
            # each of up to 60 gains is rounded to a multiple of 2^-10
            assert abs(batched[m] - expected) <= 60 * 2.0**-11 + 1e-3


@pytest.mark.parametrize("score", SCORES, ids=NAMES)
@pytest.mark.parametrize("tile", [1, 200, 5000, 1 << 20])
def test_tiles_change_no_score(score: scores.Score, tile: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = normalized_pairs(scene(0, 300), 0, 8)[0][0]
    F = _models(pairs)
    whole = score_models(score, F, pairs)
    monkeypatch.setattr(scores, "CPU_TILE", tile)
    assert torch.equal(score_models(score, F, pairs), whole)


def test_exact_sum_does_not_depend_on_the_order() -> None:
    gain = torch.rand(1, 3, 20000, generator=torch.Generator().manual_seed(0))
    shuffled = gain[..., torch.randperm(20000, generator=torch.Generator().manual_seed(1))]
    assert torch.equal(exact_sum(gain.clone()), exact_sum(shuffled.clone()))
    np.testing.assert_allclose(exact_sum(gain.clone()).numpy(), gain.double().sum(-1).numpy(), rtol=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_saturated_gains_depend_on_no_order(dtype: torch.dtype) -> None:
    """Of matches, in which sums in a cell are formed, and of models, which stand side by side in vectors."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(4, 1, 20000, generator=generator, dtype=dtype) * 2 - 1
    weight = torch.rand(1, 20000, generator=generator, dtype=dtype)
    F = torch.randn(9, 1, 37, generator=generator, dtype=dtype)
    score, unit = SaturatedGains(20.0), torch.tensor([[512.0]], dtype=torch.float64)
    scores = score(F, points, weight, unit)
    assert (scores > 0).all()
    order = torch.randperm(20000, generator=generator)
    assert torch.equal(score(F, points[..., order], weight[:, order], unit), scores)
    models = torch.randperm(37, generator=generator)
    assert torch.equal(score(F[..., models], points, weight, unit), scores[:, models])
    assert torch.equal(score(F[..., 5:6].contiguous(), points, weight, unit), scores[:, 5:6])


@pytest.mark.parametrize("threshold", [0.0, -1.0, float("nan")])
def test_threshold_must_be_positive(threshold: float) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        InlierCount(threshold)


def test_sigma_consensus_is_the_integral_over_sigma() -> None:
    # Barath et al. 2020: w(r) = integral over sigma of the chi density of r / sigma, which vanishes beyond k sigma;
    # rho is the integral of w(r) r. Everything up to a factor, which the normalisation of the gain removes.
    k, sigma_max = QUANTILE, 1.0

    def weight(r: float) -> float:
        # g(r | sigma) = 2 C(4) sigma^-4 exp(-r^2 / (2 sigma^2)) r^3: over r^3 this leaves sigma^-4 exp(...)
        density = lambda sigma: r**3 / sigma**4 * np.exp(-(r**2) / (2 * sigma**2))  # noqa: E731
        return float(integrate.quad(density, r / k, sigma_max, epsabs=1e-12)[0])

    whole = integrate.quad(lambda r: weight(r) * r, 0, k * sigma_max, epsabs=1e-9)[0]
    for share in (0.05, 0.3, 0.6, 0.9):
        r = share * k * sigma_max
        loss = integrate.quad(lambda r: weight(r) * r, 0, r, epsabs=1e-9)[0]
        gain = float(SigmaConsensus.gain(torch.tensor(share**2, dtype=torch.float64)))
        assert abs(gain - (1 - loss / whole)) < 1e-6


def test_models_that_are_none_score_minus_infinity_and_change_no_other() -> None:
    pairs = normalized_pairs(scene(0, 300), 0, 8)[0][0]
    F = _models(pairs)
    valid = torch.arange(40)[None] < 25
    scores = score_models(TruncatedSquares(2.0), F, pairs, valid=valid)
    whole = score_models(TruncatedSquares(2.0), F, pairs)
    assert torch.equal(scores, torch.where(valid, whole, -torch.inf))
