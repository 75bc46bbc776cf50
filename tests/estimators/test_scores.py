"""Scores, inliers by them, and the refinement of the best models."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import integrate

import fmtorch
from fmtorch import estimators
from fmtorch.estimators import BestScore, Candidates, Pool, Refinement, scores_of
from fmtorch.estimators.inliers import residuals_squared_px
from fmtorch.estimators.scores import GRID, fractional_bits, saturated_cells
from fmtorch.geometry.epipolar import HOMOGRAPHY, SAMPSON
from fmtorch.geometry.levenberg_marquardt import ENTRIES, QUANTILE, Schedule
from fmtorch.jit.random import Stream
from tests.estimators.own_parts import Squares
from tests.estimators.pairs import FEW, REAL, SCALES, known, models, named, pair_of, residuals
from tests.laws import scene
from tests.reference import known_cameras, refine
from tests.reference import ransac as reference
from tests.reference.random import number

SCORES: dict[str, tuple[Any, Any]] = {
    "inlier_count": (estimators.InlierCount, reference.inlier),
    "msac": (estimators.Msac, reference.truncated_square),
    "geman_mcclure": (estimators.GemanMcClure, reference.geman_mcclure),
    "magsac": (estimators.Magsac, reference.magsac),
    "saturated": (estimators.SaturatedGains, reference.geman_mcclure),
}
GAIN_ROUNDING = 2.0**-21  # of a gain of about one: eight operations in float32
RECTIFIED = np.array([[0, 0, 0, 0, 0, 1, 0, -1, 0]], np.float32)  # x1' F x0 = y0 - y1: r^2 = (y1 - y0)^2 / 2


def bounds(gain: Any, F: Any, pair: Any, threshold: float, weighted: bool, saturated: bool = False) -> Any:
    """Between which two numbers a sum of gains is, which fall with the residual, summed in float32."""
    weight = pair.prior.astype(np.float32).tolist() if weighted and pair.prior is not None else [1.0] * pair.count
    r, bits = residuals(F, pair, threshold), fractional_bits(pair.count)
    low, high = r.low, r.high
    if gain is reference.magsac:  # tabulated over r^2, each entry in the middle of its interval
        low, high = (np.sqrt(np.maximum(x**2 + d, 0)) for x, d in ((low, -0.5 / ENTRIES), (high, 0.5 / ENTRIES)))
    gains = [max(gain(x) - GAIN_ROUNDING, 0) for x in high], [gain(x) + GAIN_ROUNDING for x in low]
    if saturated:
        return [reference.saturated(each, weight, cells_of(pair, weighted), bits) for each in gains]
    return [reference.summed(each, weight, bits) for each in gains]


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
            which = np.array([5, 1, 5])
            totals = score(F, which, pair)
            assert totals[0] == totals[2]
            for k, total in zip(which[:2], totals[:2], strict=True):
                lower, most = bounds(gain, F[k], pair, threshold, weighted, name == "saturated")
                assert lower <= total <= most
                # The bounds are no idle ones: roundings, and a few matches on the threshold.
                if given not in FEW and name != "saturated":
                    assert most - lower <= 2.0**-9 * pair.count + 2


class Biweight(estimators.SummedGains):
    """The square of MSAC's gain."""

    def gain(self, squared: Any) -> Any:
        return np.maximum(1 - squared, 0) ** 2


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("given", ["scene 150", "scene 700", "real 0", "7 random", "20 collinear"])
def test_a_gain_in_numpy(given: str, weighted: bool) -> None:
    pair = named(given)
    F, which = models(pair, 8).astype(np.float32), np.array([5, 1, 2, 3, 4, 2])
    for residual in (HOMOGRAPHY, SAMPSON):
        pair.residual = residual
        compiled = estimators.Msac(1.5, weighted)(F, which, pair)
        np.testing.assert_array_equal(Squares(1.5, weighted)(F, which, pair), compiled)
    for k, total in zip(which, Biweight(1.5, weighted)(F, which, pair), strict=True):
        lower, most = bounds(lambda r: reference.truncated_square(r) ** 2, F[k], pair, 1.5, weighted)
        assert lower <= total <= most


@pytest.mark.parametrize("score", [*(kind(2.0) for kind, _ in SCORES.values()), Biweight(2.0)])
def test_sums_are_exact(score: estimators.Score) -> None:
    """Whatever the order of 20,000 matches and of models: summed are multiples of 2^-bits below 2^(24 - bits)."""
    pair = pair_of(known(20_000))
    F, which = models(pair, 6).astype(np.float32), np.arange(6)
    total = score(F, which, pair)
    shuffled = pair.take(np.random.default_rng(0).permutation(pair.count))
    np.testing.assert_array_equal(score(F, which, shuffled), total)
    np.testing.assert_array_equal(score(F, which[::-1].copy(), pair), total[::-1])
    bits = fractional_bits(pair.count)
    assert bits == 9
    np.testing.assert_array_equal(total * 2**bits, np.round(total * 2**bits))


@pytest.mark.parametrize("r", [0.05, 0.3, 0.6, 0.9])
def test_the_reference_of_magsac_is_the_integral_over_sigma(r: float) -> None:
    """Barath et al. 2020: w(r) integrates over sigma the chi density of r / sigma, which vanishes beyond k sigma.
    rho is the integral of w(r) r; a constant factor goes where the gain is normalised."""

    def weight(r: float) -> float:
        # g(r | sigma) = 2 C(4) sigma^-4 exp(-r^2 / (2 sigma^2)) r^3; the density of r has three dimensions less, r^-3
        return float(integrate.quad(lambda s: np.exp(-(r**2) / (2 * s**2)) / s**4 * r**3, r / QUANTILE, 1.0)[0])

    loss, total = (integrate.quad(lambda r: weight(r) * r, 0, QUANTILE * end, epsabs=1e-10)[0] for end in (r, 1.0))
    assert reference.magsac(r) == pytest.approx(1 - loss / total, abs=1e-8)  # the tolerance of the quadrature


def cells_of(pair: estimators.Pair, weighted: bool) -> np.ndarray:
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


@pytest.mark.parametrize("given", ["scene 40", "scene 151", "scene 700", "real 7", *FEW])
def test_medians_are_those_of_the_definition(given: str) -> None:
    """The median of numbers between bounds is between the medians of these."""
    pair = named(given)
    F, which = models(pair, 8).astype(np.float32), np.array([5, 1, 2, 3, 4, 2])
    unit = float(pair.pixels_per_unit)
    for k, score in zip(which, estimators.Median()(F, which, pair), strict=True):
        r = residuals(F[k], pair, unit)
        noise = pair.pixels_per_noise / unit  # which does not count here
        low, high = (reference.lower_median(((x / noise) ** 2).tolist()) for x in (r.low, r.high))
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
    (score,) = estimators.Median()(RECTIFIED, np.zeros(1, np.int64), pair)
    ordered = sorted(np.where(np.isnan(apart), np.inf, apart).astype(np.float32).astype(float))
    # A square, a sum of two, a quotient: three roundings of float32.
    assert -score == pytest.approx(reference.lower_median(ordered) ** 2 / 2, rel=3 * 2.0**-24)


@pytest.mark.parametrize("given", ["scene 150", "real 7", *FEW])
def test_residuals_are_squared_sampson_distances_in_pixels(given: str) -> None:
    for scale in SCALES if given in FEW else (1.0,):
        pair = named(given, scale)
        for F in models(pair, 8)[1:]:
            squared = residuals_squared_px(F, pair)
            r = residuals(F, pair, 1.0, np.float64)  # per noise
            noise = np.ones(pair.count) if pair.noise is None else pair.noise
            low, high = r.low * noise, r.high * noise
            assert ((low**2 * (1 - 1e-15) <= squared) & (squared <= high**2 * (1 + 1e-15))).all()


@pytest.mark.parametrize("count", [7, 8, 9, 20, 151])
def test_rules_are_those_of_the_definitions(count: int) -> None:
    pair, rng = named(f"scene {count}"), np.random.default_rng(count)
    spread, whole = rng.uniform(0, 3, count), rng.integers(0, 3, count) * 1.0
    for r in (spread, whole, np.zeros(count), 10.0 ** rng.uniform(-9, 9, count)):
        median = reference.lower_median((r**2).tolist())
        sigma = 1.4826 * (1 + 5 / max(count - 7, 1)) * math.sqrt(median)
        rules: list[tuple[estimators.InlierRule, list[bool]]] = [
            (estimators.WithinThreshold(1.5), [x <= 1.5**2 for x in r**2]),
            (estimators.BetterHalf(), [x <= max(median, 1e-6) for x in r**2]),
            (estimators.RobustDeviations(), [x <= max(2.5 * sigma, 1e-3) ** 2 for x in r**2]),
        ]
        for rule, expected in rules:
            assert rule(r**2, pair).tolist() == expected


@pytest.mark.parametrize("name", ["lmeds", "cf_ransac", "paper/lmeds"])
def test_all_exact_matches_are_inliers(name: str) -> None:
    """Whose deviations are rounding, of which a half is larger than the median."""
    s = known_cameras.scene(5, 150)
    inliers = fmtorch.find_fundamental(s.x0, s.x1, estimator=name).inliers[0].numpy()
    assert inliers[s.right].all()
    assert not inliers[~s.right].any()


def test_limits_belong_to_the_inliers_and_are_none_beyond_the_range_of_numbers() -> None:
    pair = named("scene 8")
    squared = np.array([0, 4, np.nextafter(4, 5), 1e300, np.inf, np.nan, 1, 2])
    assert np.flatnonzero(estimators.WithinThreshold(2.0)(squared, pair)).tolist() == [0, 1, 6, 7]
    assert estimators.WithinThreshold(1e200)(squared, pair).sum() == 7
    assert not estimators.WithinThreshold(1e-200)(squared, pair)[1:].any()


@pytest.mark.parametrize("probability", [0.5, 0.99, 0.9999])
@pytest.mark.parametrize("sampler", [estimators.Uniform(), estimators.Prosac(), estimators.PriorWeighted()])
def test_a_search_stops_after_as_many_draws_as_it_takes(sampler: estimators.Sampler, probability: float) -> None:
    pair = named("scene 150")
    shares = set()
    for F in models(pair, 12)[1:].astype(np.float32):
        for threshold in (0.1, 1.0, 10.0, 100.0):
            inside = residuals_squared_px(F.astype(np.float64), pair) <= threshold**2
            weight = sampler.weight(pair)  # type: ignore[attr-defined]
            share = float(weight[inside].sum() / weight.sum())
            for size in (5, 7):
                stop = estimators.StoppingRule(probability, threshold, sampler)
                if share in (0, 1):
                    assert stop(F, 10**9, pair, size) == (share == 1)
                    continue
                draws = reference.draws_for_confidence(share, size, probability)
                assert stop(F, math.ceil(draws * (1 + 1e-9)), pair, size)
                assert not stop(F, math.ceil(draws * (1 - 1e-9)) - 1, pair, size)
                shares.add(share)
    assert len(shares) > 10


def pool_of(F: np.ndarray) -> Pool:
    return Pool(F.astype(np.float32), np.arange(len(F), 0, -1.0), len(F))


@pytest.mark.parametrize("name", ["scene 40", "scene 300", "real 7", *FEW])
def test_matches_near_a_pool(name: str) -> None:
    """Within four scales of a model, the first in the order of their random numbers; nothing is near a zero model."""
    for scale in SCALES if name in FEW else (1.0,):
        pair, F = named(name, scale, seed=2), models(named(name, scale), 6)
        reach = estimators.Refine.RADIUS * 1.5 * scale
        rs = [residuals(model, pair, reach * pair.pixels_per_noise / pair.pixels_per_unit) for model in F[1:]]
        surely = set(np.flatnonzero(np.any([r.high < 1 for r in rs], 0)).tolist())
        perhaps = set(np.flatnonzero(np.any([r.low <= 1 for r in rs], 0)).tolist())
        words = [number(pair.seed, pair.key, Stream.REFINEMENT, 0, i, 1) for i in range(pair.count)]
        options = estimators.Refine("truncated", 1.5 * scale, matches=pair.count)
        near = Refinement(options).near(pool_of(F), pair)
        index = [int(np.flatnonzero((pair.table == column[:, None]).all(0))[0]) for column in near.table.T]
        if len({tuple(column) for column in pair.table.T}) == pair.count:  # else equal matches are not told apart
            assert surely <= set(index) <= perhaps
            assert index == reference.shuffled(sorted(index), words, pair.count)
        for count in (1, 5):
            fewer = Refinement(estimators.Refine("truncated", 1.5 * scale, matches=count)).near(pool_of(F), pair)
            np.testing.assert_array_equal(fewer.table, near.table[:, :count])


def test_all_matches_are_near_without_a_number_of_them() -> None:
    pair, F = named("scene 40"), models(named("scene 40"), 3)
    assert Refinement(estimators.Refine("truncated")).near(pool_of(F), pair) is pair
    assert Refinement(None).near(pool_of(F), pair) is pair
    nothing = Refinement(estimators.Refine("truncated", matches=10)).near(Pool.empty(4), pair)
    assert nothing.count == 0


@pytest.mark.parametrize("loss", ["truncated", "geman_mcclure", "cauchy", "huber", "magsac"])
@pytest.mark.parametrize("name", ["scene 40", "scene 300", "real 7"])
def test_refined_models_have_lower_errors(name: str, loss: str) -> None:
    pair, scale = named(name), 2.0
    pool = estimators.Ransac(hypotheses=200, pool=4).search(pair)
    refined = Refinement(estimators.Refine(loss, scale, iterations=20))(pool, pair, estimators.SevenPoint())
    assert refined.valid
    assert refined.near is pair

    def cost(F: np.ndarray, pair: estimators.Pair) -> float:
        r = residuals(F, pair, scale, np.float64).exact
        return float((pair.weight * refine.loss(r**2, 1.0, loss) / pair.pixels_per_noise**2).sum())

    before, after = ([cost(F, pair) for F in models] for models in (pool.models, refined.F))
    assert all(a <= b * (1 + 1e-6) for a, b in zip(after, before, strict=True))  # first made rank 2, to float32
    assert any(a < b * (1 - 1e-3) for a, b in zip(after, before, strict=True))


def test_local_optimisation_comes_first() -> None:
    pair, F = named("scene 40"), models(named("scene 40"), 3)[1:]
    refined = Refinement(None, lambda F, pair: F + 1)(pool_of(F), pair, estimators.SevenPoint())
    np.testing.assert_array_equal(refined.F, F.astype(np.float32).astype(np.float64) + 1)
    plain = Refinement(None)(Pool.empty(3), pair, estimators.SevenPoint())
    assert not plain.valid


def test_the_best_score_of_the_pool() -> None:
    pair, F = pair_of(scene(1, 100)), np.random.default_rng(0).normal(size=(6, 9))
    best = int(np.argmax(scores_of(estimators.Msac(50.0), F, pair)))
    assert best > 0
    np.testing.assert_array_equal(BestScore(estimators.Msac(50.0))(Candidates(F, True, pair), pair).F, F[best])
    assert not BestScore(estimators.Msac(50.0))(Candidates(F, False, pair), pair).valid


@pytest.mark.parametrize(("noise", "count"), [(0.01, 300), (0.3, 300), (0.6, 300), (9.0, 300), (0.3, 14)])
def test_the_second_choice_is_made_at_the_noise_of_the_pair(noise: float, count: int) -> None:
    """The scale is 1.5 robust deviations of the likely matches within 2 px of the first choice, 0.3 to 2 px, and
    1.5 px where these are fewer than 15. A score with a threshold of its own keeps it."""
    pair = pair_of(scene(2, count, outliers=0.1, noise=noise))
    F = estimators.SevenPoint().refine(models(pair, 30)[1:], pair, "cauchy", 2.0, Schedule(20, 1e-4, 0.0))
    first = F[int(np.argmax(scores_of(estimators.Msac(0.3), F, pair)))]
    r = np.sqrt(residuals_squared_px(first, pair)) / pair.noises
    r = r[(r <= 2) & (pair.match_weight > 0.3)]
    scale = 1.5 if len(r) < 15 else np.clip(1.5 * 1.4826 * np.quantile(r, 0.5, method="inverted_cdf"), 0.3, 2.0)
    select: Any = estimators.Ransac(select={"score": "msac", "scale": 0.3, "own_noise": 1.5}).select
    np.testing.assert_allclose(select.of_pair(first, pair).threshold, scale, rtol=1e-12)
    best = int(np.argmax(scores_of(estimators.Msac(float(scale)), F, pair)))
    np.testing.assert_array_equal(select(Candidates(F, True, pair), pair).F, F[best])
    own: Any = estimators.Ransac(select={"score": {"name": "msac", "threshold": 1.0}, "scale": 1.0, "own_noise": 1.5})
    assert own.select.of_pair(first, pair).threshold == 1.0


@pytest.mark.parametrize("threshold", [0.0, -1.0, float("nan")])
def test_a_threshold_must_be_positive(threshold: float) -> None:
    for kind, _ in SCORES.values():
        with pytest.raises(ValueError, match=f"threshold is {threshold}; .* must be positive"):
            kind(threshold)
