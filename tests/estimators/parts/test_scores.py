"""Sums of gains, against their definitions: between what residuals rounded up and rounded down would give."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import integrate

from fmtorch.estimators.pair import Pair
from fmtorch.estimators.scores import GemanMcClure, InlierCount, Magsac, Msac, Score, SummedGains, fractional_bits
from fmtorch.geometry.epipolar import HOMOGRAPHY, SAMPSON
from fmtorch.geometry.robust_losses import ENTRIES, QUANTILE
from tests.estimators.pairs import FEW, REAL, SCALES, known, models, named, pair_of
from tests.estimators.residuals import residuals
from tests.reference import ransac as reference

SCORES: dict[str, tuple[type[SummedGains], Any]] = {
    "inlier_count": (InlierCount, reference.inlier),
    "msac": (Msac, reference.truncated_square),
    "geman_mcclure": (GemanMcClure, reference.geman_mcclure),
    "magsac": (Magsac, reference.magsac),
}
GAIN_ROUNDING = 2.0**-21  # of a gain of about one: eight operations in float32


def bounds(gain: Any, F: Any, pair: Pair, threshold: float, weighted: bool) -> tuple[float, float]:
    """Between what a sum of gains is, which fall with the residual, summed in float32."""
    weight = pair.prior.astype(np.float32).tolist() if weighted and pair.prior is not None else [1.0] * pair.count
    r, bits = residuals(F, pair, threshold), fractional_bits(pair.count)
    low, high = r.low, r.high
    if gain is reference.magsac:  # tabulated over r^2, each entry in the middle of its interval
        low, high = (np.sqrt(np.maximum(x**2 + d, 0)) for x, d in ((low, -0.5 / ENTRIES), (high, 0.5 / ENTRIES)))
    lower = [max(gain(x) - GAIN_ROUNDING, 0) for x in high]
    most = [gain(x) + GAIN_ROUNDING for x in low]
    return reference.summed(lower, weight, bits), reference.summed(most, weight, bits)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize("given", ["scene 150", "scene 700", REAL[1], *FEW])
def test_scores_are_those_of_the_definitions(given: str, name: str, weighted: bool) -> None:
    kind, gain = SCORES[name]
    for scale in SCALES if given in FEW else (1.0,):
        pair = named(given, scale)
        F = models(pair, 8).astype(np.float32)
        for threshold in {1.5, 1.5 * scale}:
            score = kind(threshold)
            score.prior_weighted = weighted
            which = np.array([5, 1, 2, 3, 4, 2])
            totals = score(F, which, pair)
            for k, total in zip(which, totals, strict=True):
                lower, most = bounds(gain, F[k], pair, threshold, weighted)
                assert lower <= total <= most
                if given not in FEW:  # the bounds are no idle ones: roundings, and a few matches on the threshold
                    assert most - lower <= 2.0**-9 * pair.count + 2


class Biweight(SummedGains):
    """The square of MSAC's gain."""

    def gain(self, squared: Any) -> Any:
        return np.maximum(1 - squared, 0) ** 2


class TruncatedSquares(SummedGains):
    """MSAC's gain."""

    def gain(self, squared: Any) -> Any:
        return 1 - squared  # what is negative counts nothing


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("given", ["scene 150", "scene 700", "real 0", "7 random", "20 collinear"])
def test_a_gain_in_numpy(given: str, weighted: bool) -> None:
    pair = named(given)
    F, which = models(pair, 8).astype(np.float32), np.array([5, 1, 2, 3, 4, 2])
    for residual in (HOMOGRAPHY, SAMPSON):
        pair.residual = residual
        compiled = Msac(1.5, weighted)(F, which, pair)
        np.testing.assert_array_equal(TruncatedSquares(1.5, weighted)(F, which, pair), compiled)
    for k, total in zip(which, Biweight(1.5, weighted)(F, which, pair), strict=True):
        lower, most = bounds(lambda r: reference.truncated_square(r) ** 2, F[k], pair, 1.5, weighted)
        assert lower <= total <= most


@pytest.mark.parametrize("score", [*(kind(2.0) for kind, _ in SCORES.values()), Biweight(2.0)])
def test_sums_are_exact(score: Score) -> None:
    """Whatever the order of 20,000 matches: what is summed are multiples of 2^-bits below 2^(24 - bits)."""
    pair = pair_of(known(20_000))
    F, which = models(pair, 6).astype(np.float32), np.arange(6)
    total = score(F, which, pair)
    order = np.random.default_rng(0).permutation(pair.count)
    shuffled = pair.take(order)
    np.testing.assert_array_equal(score(F, which, shuffled), total)
    bits = fractional_bits(pair.count)
    assert bits == 9
    np.testing.assert_array_equal(total * 2**bits, np.round(total * 2**bits))


@pytest.mark.parametrize("r", [0.05, 0.3, 0.6, 0.9])
def test_the_reference_of_magsac_is_the_integral_over_sigma(r: float) -> None:
    """Barath et al. 2020: w(r) integrates over sigma the chi density of r / sigma, which vanishes beyond k sigma.

    rho is the integral of w(r) r; a constant factor goes where the gain is normalised.
    """

    def weight(r: float) -> float:
        # g(r | sigma) = 2 C(4) sigma^-4 exp(-r^2 / (2 sigma^2)) r^3; the density of r has three dimensions less, r^-3
        return float(integrate.quad(lambda s: np.exp(-(r**2) / (2 * s**2)) / s**4 * r**3, r / QUANTILE, 1.0)[0])

    loss, total = (integrate.quad(lambda r: weight(r) * r, 0, QUANTILE * end, epsabs=1e-10)[0] for end in (r, 1.0))
    assert reference.magsac(r) == pytest.approx(1 - loss / total, abs=1e-8)  # the tolerance of the quadrature


@pytest.mark.parametrize(("count", "bits"), [(1, 10), (2**14, 10), (2**14 + 1, 9), (2**20, 4)])
def test_fractional_bits(count: int, bits: int) -> None:
    """So many numbers up to 1 have a sum of 24 bits at most."""
    assert fractional_bits(count) == bits
    assert count * 2**bits <= 2**24


@pytest.mark.parametrize("threshold", [0.0, -1.0, float("nan")])
def test_a_threshold_must_be_positive(threshold: float) -> None:
    for kind, _ in SCORES.values():
        with pytest.raises(ValueError, match=f"threshold is {threshold}; .* must be positive"):
            kind(threshold)


def test_a_score_without_a_gain_is_told() -> None:
    class Nothing(SummedGains):
        pass

    pair = named("scene 40")
    with pytest.raises(NotImplementedError, match="Nothing must override `gain` or name a `gain_kernel`"):
        Nothing(1.0)(models(pair, 2).astype(np.float32), np.arange(2), pair)
