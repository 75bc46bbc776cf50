"""Scores equal their definitions, match by match, for matches of any prior, noise and number."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import integrate

from fmtorch.estimators.pair import Pair
from fmtorch.estimators.parts.median import Median, score_median_of
from fmtorch.estimators.parts.saturated import GRID, SaturatedGains
from fmtorch.estimators.parts.scored_matches import fractional_bits, scored_matches
from fmtorch.estimators.parts.scores import (
    GemanMcClure,
    InlierCount,
    Magsac,
    Msac,
    SummedGains,
    squared_residuals_of,
    sum_gains,
)
from fmtorch.geometry.homography_objective_kernels import HOMOGRAPHY
from fmtorch.geometry.magsac import GAIN_TABLE, QUANTILE
from fmtorch.geometry.residual_kernels import MATCH, SAMPSON, SINGLES, Residual
from tests.estimators.pairs import pair_of
from tests.laws import degenerate, scene
from tests.reference import ransac as reference

THRESHOLD = 2.0
GEMAN_MCCLURE_REACH = 5.0  # scales, from which on the gain is zero
CASES = ["8", "60", "701", "701 of different noise", "collinear", "identity"]


def matches(case: str) -> Pair:
    if not case[0].isdigit():
        return pair_of(degenerate()[case])
    count = int(case.split()[0])
    c = scene(count, count)
    return pair_of(c.replace(noise=torch.linspace(0.2, 5, count)[None]) if "noise" in case else c)


def models(count: int = 40) -> np.ndarray:
    """Models of any kind, residuals from a hundredth of a pixel to hundreds, and one of zeros."""
    F = np.random.default_rng(0).normal(size=(count, 9)) * np.logspace(-2, 0, 9)
    F[0] = 0
    return F.astype(np.float32)


def residuals_px(F: np.ndarray, pair: Pair) -> np.ndarray:
    """Sampson distances (n,) in pixels over noise."""
    points, F = pair.points32.astype(np.float64), F.astype(np.float64).reshape(3, 3)
    with np.errstate(invalid="ignore"):
        r = np.array([reference.sampson(F, points[:2, i], points[2:, i]) for i in range(pair.count)])
    return np.nan_to_num(r, nan=np.inf) * pair.pixels_per_noise


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("name", ["count", "msac", "geman_mcclure", "saturated"])
def test_scores_equal_their_definitions(name: str, weighted: bool, case: str) -> None:
    pair, F = matches(case), models()
    kind = {"count": InlierCount, "msac": Msac, "geman_mcclure": GemanMcClure, "saturated": SaturatedGains}[name]
    scores = kind(THRESHOLD, weighted)(F, np.arange(len(F))[::-1].copy(), pair)[::-1]
    prior = pair.match_weight if weighted else np.ones(pair.count)
    unit = 2.0 ** -fractional_bits(pair.count)  # of rounded gains: each is off by half of it at most, times 2
    for k in range(1, len(F)):
        r = residuals_px(F[k], pair)
        if name == "count":
            border = np.abs(r - THRESHOLD) < 1e-3  # float32 residuals this close to it may fall either way
            assert abs(scores[k] - prior[r <= THRESHOLD].sum()) <= prior[border].sum() + pair.count * unit
        elif name == "msac":
            assert abs(scores[k] - reference.msac(r, THRESHOLD, prior)) <= pair.count * unit + 1e-3
        elif name == "geman_mcclure":
            expected = reference.geman_mcclure(r, THRESHOLD, GEMAN_MCCLURE_REACH, prior)
            assert abs(scores[k] - expected) <= pair.count * unit + 1e-3
        elif case in ("60", "701"):  # the grid of weightless or collinear matches is the kernel's own affair
            expected = reference.saturated(
                r, pair.points32.astype(np.float64), THRESHOLD, GEMAN_MCCLURE_REACH, GRID, prior
            )
            # The root of a gain that is rounded to nothing is missed: 2^-5.5 for the smallest one, in a few cells.
            assert abs(scores[k] - expected) <= 8 * 2.0**-5.5


@pytest.mark.parametrize("case", ["8", "60", "701", "identity"])
def test_the_median_is_the_lower_one(case: str) -> None:
    pair, F = matches(case), models()[1:]
    scores = Median()(F, np.arange(len(F)), pair)
    for k in range(len(F)):
        r = residuals_px(F[k], pair) / pair.pixels_per_noise
        # A residual of float32 points is a difference of products of 1, rounded to 1e-7 each.
        assert np.sqrt(-scores[k]) == pytest.approx(reference.lower_median(r), rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("kind", ["equal", "tiny and huge", "many zero"])
def test_the_median_of_unusual_residuals(kind: str) -> None:
    """x1' F x0 = y1 - y0 for F of rectified images, so that squared residuals are half of (y1 - y0)^2."""
    n = 101
    apart = {"equal": np.full(n, 0.5), "tiny and huge": 10.0 ** np.linspace(-15, 15, n)}.get(kind, np.arange(n) // 60.0)
    rows = np.zeros((-(-n // SINGLES) * MATCH, SINGLES), np.float32)
    shuffled = np.random.default_rng(0).permutation(apart).astype(np.float32)
    for i in range(n):
        first, lane = i // SINGLES * MATCH, i % SINGLES
        rows[first + 3, lane], rows[first + 4, lane], rows[first + 5, lane] = shuffled[i], 1, 1
    F, out = np.array([[0, 0, 0, 0, 0, 1, 0, -1, 0]], np.float32), np.empty(1)
    score_median_of(SAMPSON)(F, np.zeros(1, np.int64), rows, n, out)
    assert -out[0] == pytest.approx(np.sort(shuffled.astype(np.float64) ** 2 / 2)[(n + 1) // 2 - 1], rel=1e-6)


@pytest.mark.parametrize("gain", [0.05, 0.3, 0.6, 0.9])
def test_the_gain_of_magsac_is_the_integral_over_sigma(gain: float) -> None:
    """Barath et al. 2020: w(r) integrates over sigma the chi density of r / sigma, which vanishes beyond k sigma.

    rho is the integral of w(r) r. Everything up to a factor, which the normalisation of the gain removes.
    """
    k, r = QUANTILE, gain * QUANTILE

    def weight(r: float) -> float:
        # g(r | sigma) = 2 C(4) sigma^-4 exp(-r^2 / (2 sigma^2)) r^3: over r^3 this leaves sigma^-4 exp(...)
        def density(sigma: float) -> float:
            return float(r**3 / sigma**4 * np.exp(-(r**2) / (2 * sigma**2)))

        return float(integrate.quad(density, r / k, 1.0, epsabs=1e-12)[0])

    whole = integrate.quad(lambda r: weight(r) * r, 0, k, epsabs=1e-9)[0]
    loss = integrate.quad(lambda r: weight(r) * r, 0, r, epsabs=1e-9)[0]
    # The table has 2048 entries, each the gain in the middle of its interval; the gain falls by 5 of the range at most.
    entry = GAIN_TABLE[int(gain**2 * (len(GAIN_TABLE) - 1))]
    assert float(entry) == pytest.approx(1 - loss / whole, abs=5 / 4096)


def test_magsac_sums_the_gains_of_its_table() -> None:
    pair, F = matches("701"), models()[1:]
    scores = Magsac(THRESHOLD)(F, np.arange(len(F)), pair)
    for k in range(len(F)):
        u = (residuals_px(F[k], pair) / THRESHOLD) ** 2
        entry = np.minimum(u, 1) * (len(GAIN_TABLE) - 1)
        # A float32 residual may fall into a neighbouring entry, and gains are rounded.
        steps = sum(
            float(GAIN_TABLE[max(int(e) - 1, 0)] - GAIN_TABLE[min(int(e) + 1, 2048)]) for e in entry if e < 2048
        )
        assert abs(scores[k] - GAIN_TABLE[entry.astype(int)].sum()) <= 701 * 2.0**-10 + steps


def test_no_order_of_matches_or_models_changes_a_score() -> None:
    """Sums of rounded gains are exact, and lanes of vectors are alike."""
    pair, F = matches("701"), models()
    order = np.random.default_rng(1).permutation(pair.count)
    which = np.random.default_rng(2).permutation(len(F))
    for score in (
        InlierCount(20.0),
        Msac(20.0, True),
        GemanMcClure(20.0),
        Magsac(20.0),
        SaturatedGains(20.0),
        Median(),
    ):
        scores = score(F, np.arange(len(F)), pair)
        np.testing.assert_array_equal(score(F, np.arange(len(F)), pair.take(order)), scores)
        np.testing.assert_array_equal(score(F, which, pair), scores[which])
        np.testing.assert_array_equal(score(F, np.array([5]), pair), scores[5:6])


@pytest.mark.parametrize("residual", [SAMPSON, HOMOGRAPHY])
@pytest.mark.parametrize("case", ["8", "701 of different noise"])
def test_a_score_of_gains_in_numpy_is_the_compiled_one(case: str, residual: Residual) -> None:
    class InNumPy(SummedGains):
        def gain(self, squared: np.ndarray) -> np.ndarray:
            return np.maximum(1 - squared, 0).astype(np.float32)

    pair, F = matches(case), models()
    pair.residual = residual
    for weighted in (False, True):
        compiled = Msac(THRESHOLD, weighted)(F, np.arange(len(F)), pair)
        np.testing.assert_array_equal(InNumPy(THRESHOLD, weighted)(F, np.arange(len(F)), pair), compiled)


def test_sums_are_those_of_rounded_gains() -> None:
    pair, rng = matches("701"), np.random.default_rng(0)
    gains = rng.random((3, pair.count)).astype(np.float32)
    rows, out, bits = scored_matches(pair, 1.0, True), np.empty(3), fractional_bits(pair.count)
    sum_gains(gains, rows, bits, out)
    assert (out * 2**bits == np.round(out * 2**bits)).all()
    np.testing.assert_allclose(out, gains @ pair.match_weight, atol=pair.count * 2.0**-bits)


def test_residuals_of_every_match() -> None:
    pair, F = matches("701 of different noise"), models()[1:]
    squared = np.empty((len(F), pair.count), np.float32)
    squared_residuals_of(SAMPSON)(F, np.arange(len(F)), scored_matches(pair, THRESHOLD, False), squared)
    for k in range(len(F)):
        np.testing.assert_allclose(np.sqrt(squared[k]) * THRESHOLD, residuals_px(F[k], pair), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("threshold", [0.0, -1.0, float("nan")])
def test_a_threshold_is_a_positive_distance(threshold: float) -> None:
    for score in (InlierCount, SaturatedGains):
        with pytest.raises(ValueError, match="must be positive"):
            score(threshold)
