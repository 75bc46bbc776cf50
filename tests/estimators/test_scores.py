"""Sums of gains, against their definitions: between what residuals rounded up and rounded down would give."""

from typing import Any

import numpy as np
import pytest
from scipy import integrate

from fmtorch.estimators import GemanMcClure, InlierCount, Magsac, Median, Msac, Pair, SaturatedGains, Score, SummedGains
from fmtorch.estimators.scores import GRID, fractional_bits, saturated_cells
from fmtorch.geometry.epipolar import HOMOGRAPHY, SAMPSON
from fmtorch.geometry.robust_losses import ENTRIES, QUANTILE
from tests.estimators.pairs import FEW, REAL, SCALES, known, models, named, pair_of
from tests.estimators.residuals import residuals
from tests.reference import ransac as reference
from tests.reference.ransac import lower_median

SCORES: dict[str, tuple[Any, Any]] = {
    "inlier_count": (InlierCount, reference.inlier),
    "msac": (Msac, reference.truncated_square),
    "geman_mcclure": (GemanMcClure, reference.geman_mcclure),
    "magsac": (Magsac, reference.magsac),
    "saturated": (SaturatedGains, reference.geman_mcclure),
}
GAIN_ROUNDING = 2.0**-21  # of a gain of about one: eight operations in float32


def bounds(
    gain: Any, F: Any, pair: Pair, threshold: float, weighted: bool, saturated: bool = False
) -> tuple[float, float]:
    """Between what a sum of gains is, which fall with the residual, summed in float32."""
    weight = pair.prior.astype(np.float32).tolist() if weighted and pair.prior is not None else [1.0] * pair.count
    r, bits = residuals(F, pair, threshold), fractional_bits(pair.count)
    low, high = r.low, r.high
    if gain is reference.magsac:  # tabulated over r^2, each entry in the middle of its interval
        low, high = (np.sqrt(np.maximum(x**2 + d, 0)) for x, d in ((low, -0.5 / ENTRIES), (high, 0.5 / ENTRIES)))
    gains = [max(gain(x) - GAIN_ROUNDING, 0) for x in high], [gain(x) + GAIN_ROUNDING for x in low]
    if saturated:
        lower, most = (reference.saturated(each, weight, cells_of(pair, weighted), bits) for each in gains)
    else:
        lower, most = (reference.summed(each, weight, bits) for each in gains)
    return lower, most


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
                lower, most = bounds(gain, F[k], pair, threshold, weighted, name == "saturated")
                assert lower <= total <= most
                # The bounds are no idle ones: roundings, and a few matches on the threshold.
                if given not in FEW and name != "saturated":
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
    """Whatever the order of 20,000 matches and of models: summed are multiples of 2^-bits below 2^(24 - bits)."""
    pair = pair_of(known(20_000))
    F, which = models(pair, 6).astype(np.float32), np.arange(6)
    total = score(F, which, pair)
    order = np.random.default_rng(0).permutation(pair.count)
    shuffled = pair.take(order)
    np.testing.assert_array_equal(score(F, which, shuffled), total)
    np.testing.assert_array_equal(score(F, which[::-1].copy(), pair), total[::-1])
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


@pytest.mark.parametrize("threshold", [0.0, -1.0, float("nan")])
def test_a_threshold_must_be_positive(threshold: float) -> None:
    for kind, _ in SCORES.values():
        with pytest.raises(ValueError, match=f"threshold is {threshold}; .* must be positive"):
            kind(threshold)


def cells_of(pair: Pair, weighted: bool) -> np.ndarray:
    cells = np.empty((2, pair.count), np.int32)
    saturated_cells(pair.table, weighted, cells)
    return cells


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("given", ["scene 150", "scene 700", "real 7", *FEW])
def test_cells_are_those_of_the_grid_over_the_matches_of_weight(given: str, weighted: bool) -> None:
    for scale in SCALES if given in FEW else (1.0,):
        pair = named(given, scale)
        pair.match_weight[:3] *= 0
        points = pair.points32.astype(np.float64)
        inside = points[:, 3:] if weighted else points
        low, extent = inside.min(1, keepdims=True), np.ptp(inside, axis=1, keepdims=True)
        share = np.where(extent > 0, (points - low) / np.where(extent > 0, extent, 1), 0) * GRID
        clear = np.abs(share - np.round(share)) > 1e-4  # of a border: shares have an error of some 2^-20
        clear |= (share < 1e-9) | (share > GRID - 1e-9)  # cut off
        cell = np.clip(share, 0, GRID - 1).astype(int)
        cells = cells_of(pair, weighted) - [[0], [GRID * GRID]]
        for image in range(2):
            certain = clear[2 * image] & clear[2 * image + 1]
            assert given in FEW or certain.mean() > 0.99
            x, y = cell[2 * image, certain], cell[2 * image + 1, certain]
            np.testing.assert_array_equal(cells[image, certain], x + GRID * y)


def test_saturation_prefers_what_explains_the_whole_image() -> None:
    """Of two pairs with as many inliers each, the one whose inliers lie in more cells scores higher."""
    spread = np.linspace(-0.9, 0.9, 128)
    crowd = np.where(np.arange(128) < 2, [-0.9, 0.9] * 64, 0.5)  # two in the corners span the same grid
    horizontal = np.array([[0, 0, -1, 0, 0, 0, 1, 0, 0]], np.float32)  # x1 - x0 = 0
    scores = []
    for x in (spread, crowd):
        pair = pair_of(known(128, "nothing"))
        pair.table[:4] = x
        scores.append(float(SaturatedGains(1.0)(horizontal, np.zeros(1, np.int64), pair)[0]))
    # On the diagonal of the grid there are 12 cells, one match in ten or eleven in each; against one of 126, and two.
    matches = np.bincount(np.minimum((spread + 0.9) / 1.8 * 12, 11).astype(int))
    assert scores[0] == pytest.approx(2 * np.sqrt(matches).sum(), abs=24 * 2.0**-11)
    assert scores[1] == pytest.approx(2 * (np.sqrt(126) + 2), abs=6 * 2.0**-11)


RECTIFIED = np.array([[0, 0, 0, 0, 0, 1, 0, -1, 0]], np.float32)  # x1' F x0 = y0 - y1: r^2 = (y1 - y0)^2 / 2


@pytest.mark.parametrize("given", ["scene 40", "scene 151", "scene 700", "real 7", *FEW])
def test_medians_are_those_of_the_definition(given: str) -> None:
    """The median of numbers between bounds is between the medians of these."""
    pair = named(given)
    F, which = models(pair, 8).astype(np.float32), np.array([5, 1, 2, 3, 4, 2])
    unit = float(pair.pixels_per_unit)
    for k, score in zip(which, Median()(F, which, pair), strict=True):
        r = residuals(F[k], pair, unit)
        noise = pair.pixels_per_noise / unit  # which does not count here
        low, high = (lower_median(((x / noise) ** 2).tolist()) for x in (r.low, r.high))
        assert low <= -score <= high


@pytest.mark.parametrize("kind", ["equal", "tiny and huge", "some zero", "NaN"])
@pytest.mark.parametrize("count", [8, 101])
def test_the_median_of_unusual_residuals(kind: str, count: int) -> None:
    pair = pair_of(known(count, "nothing"))
    apart = {
        "equal": np.full(count, 0.5), "tiny and huge": 10.0 ** np.linspace(-15, 15, count),
        "some zero": np.arange(count) // (0.6 * count), "NaN": np.where(np.arange(count) < 3, np.nan, np.arange(count)),
    }[kind]  # fmt: skip
    pair.table[:4] = 0
    pair.table[3] = np.random.default_rng(0).permutation(apart)
    (score,) = Median()(RECTIFIED, np.zeros(1, np.int64), pair)
    ordered = sorted(np.where(np.isnan(apart), np.inf, apart).astype(np.float32).astype(float))
    # A square, a sum of two, a quotient: three roundings of float32.
    assert -score == pytest.approx(lower_median(ordered) ** 2 / 2, rel=3 * 2.0**-24)
