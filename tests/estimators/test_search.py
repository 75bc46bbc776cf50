"""The search: samples, their preselection, and the best models of many."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from fmtorch import estimators
from fmtorch.core import Correspondences
from fmtorch.estimators import Hypotheses, Pool, Preselection, Search, Verified, largest_weight, preselection
from fmtorch.jit.random import Stream
from tests.estimators.pairs import FEW, SCALES, known, models, named, pair_of
from tests.laws import scene
from tests.reference import ransac as reference
from tests.reference import solvers
from tests.reference.random import number

SEED = 3
EPS32 = 2.0**-23


@dataclasses.dataclass
class Told(estimators.StoppingRule):
    """A stopping rule that does as told, and counts how often it is asked."""

    answer: Callable[[int], bool]
    asked: list[int] = dataclasses.field(default_factory=list)

    def __call__(self, F: Any, draws: int, pair: estimators.Pair, size: int) -> bool:
        self.asked.append(draws)
        return self.answer(draws)


class Late(estimators.SevenPoint):
    """Samples before the hundredth give no model."""

    def solve(self, pair: estimators.Pair, sample: Any, start: int) -> Hypotheses:
        hypotheses = super().solve(pair, sample, start)
        return hypotheses if start >= 100 else hypotheses._replace(F=hypotheses.F[:0], draw=hypotheses.draw[:0])


def search(family: Any = None, sampler: estimators.Sampler | None = None, **options: Any) -> Search:
    preselection = Preselection(estimators.Msac(1.0), options.pop("preselect", None))
    options = {"pool": 4, "hypotheses": 150, "round": 50, **options}
    return Search(family or estimators.SevenPoint(), sampler or estimators.Uniform(), preselection, **options)


@pytest.mark.parametrize("family", [estimators.SevenPoint(), estimators.EightPoint()])
@pytest.mark.parametrize("sampler", [estimators.Uniform(), estimators.Prosac(), estimators.PriorWeighted()])
def test_models_are_those_of_the_samples_of_their_draws(family: Any, sampler: estimators.Sampler) -> None:
    """In the order of draws; each sample gives those that the definition gives and that its matches' sides agree to."""
    pair, draws, alike = named("scene 300"), 60, 0
    sample = sampler.draw(pair, 40, draws, family.size)
    hypotheses = family.solve(pair, sample, 40)
    assert hypotheses.start == 40
    np.testing.assert_array_equal(hypotheses.sample, sample)
    assert (np.diff(hypotheses.draw) >= 0).all()
    for d in range(draws):
        x0, x1 = pair.points[:2, sample[:, d]].T, pair.points[2:, sample[:, d]].T
        every = solvers.seven_point(x0, x1) if family.size == 7 else [solvers.eight_point(x0, x1)]
        expected = [F for F in every if solvers.consistently_oriented(F, x0, x1)]
        models = [solvers.unit(F.astype(np.float64).reshape(3, 3)) for F in hypotheses.F[hypotheses.draw == d]]
        # Models are float32, of norm one; what is left of rounding grows where a sample is nearly degenerate.
        alike += len(models) == len(expected) and all(
            min(min(np.abs(F - other).max(), np.abs(F + other).max()) for other in expected) < 1e-5 for F in models
        )
    assert alike >= 0.95 * draws
    assert len(hypotheses.F) > 10


def test_a_pool_keeps_the_best_and_the_earlier_of_equals() -> None:
    """What is not finite is no score; beyond that a stable sort of all that it was offered."""
    pool = Pool.empty(3)
    assert pool.models.shape == (1, 9)
    assert not pool.models.any()
    assert not pool.filled
    for scores, first, kept, best in (
        ([1.0, 3.0], 10, [11, 10], [3, 1]),
        ([3.0, np.nan, -np.inf, 2.0, 0.0, np.inf], 20, [11, 20, 23], [3, 3, 2]),
        ([3.0, 2.0], 30, [11, 20, 30], [3, 3, 3]),
    ):
        F = np.repeat(np.arange(first, first + len(scores), dtype=np.float32)[:, None], 9, 1)
        pool.merge(Verified(F, np.arange(len(scores)), np.array(scores)))
        assert (pool.F[: pool.filled, 0].tolist(), pool.score[: pool.filled].tolist()) == (kept, best)


@pytest.mark.parametrize("preselect", [None, estimators.Preselect(64, 20)])
def test_a_search_keeps_the_best_models_of_all_rounds(preselect: estimators.Preselect | None) -> None:
    pair, single = named("scene 300"), search(preselect=preselect, round=50)
    pool = single(pair, 30)
    F, score = [], []
    for start in (30, 80, 130):
        hypotheses = single.family.solve(pair, estimators.Uniform().draw(pair, start, 50, 7), start)
        which, scores = single.preselection(hypotheses.F, pair)
        F.append(hypotheses.F[which])
        score.append(scores)
    best = np.argsort(-np.concatenate(score), kind="stable")[:4]
    np.testing.assert_array_equal(pool.F, np.concatenate(F)[best])
    np.testing.assert_array_equal(pool.score, np.concatenate(score)[best])
    assert (pool.filled, pool.samples) == (4, 180)


def test_a_search_ends_when_the_stopping_rule_says_so() -> None:
    pair = named("scene 300")
    never, second = Told(lambda draws: False), Told(lambda draws: draws >= 100)
    assert search(stop=never)(pair).samples == 150
    assert never.asked == [50, 100]  # after the last round there is nothing to decide
    assert search(stop=second)(pair).samples == 100
    assert search(round=500, stop=Told(lambda draws: True))(pair).samples == 150


def test_a_search_goes_on_while_no_sample_gave_a_model() -> None:
    """All matches are inliers of the zero model that an empty pool holds."""
    pair = pair_of(scene(0, 100, outliers=0.0, noise=0.0))
    pool = search(Late(), stop=estimators.StoppingRule(0.9999, 1.0, estimators.Uniform()), hypotheses=400)(pair)
    assert pool.filled
    assert pool.samples == 150


@pytest.mark.parametrize("given", ["scene 40", "scene 129", "scene 700", "7 random", "20 collinear"])
def test_few_matches_are_those_of_the_definitions(given: str) -> None:
    pair = named(given, seed=SEED)
    n, prior = pair.count, pair.prior.copy()
    words = [number(SEED, pair.key, Stream.PRESELECTION, 0, i, 1) for i in range(n)]
    for count in (1, 5, n - 1, n, 2 * n):
        any_few, likely = preselection.shuffled_first(pair, count), preselection.drawn_by_prior(pair, count)
        np.testing.assert_array_equal(any_few.table, pair.table[:, reference.shuffled(range(n), words, count)])
        drawn = reference.priority_sample(prior.tolist(), words, count)
        np.testing.assert_array_equal(likely.points, pair.points[:, drawn])
        np.testing.assert_array_equal(likely.match_weight, prior[drawn] > 0)
    np.testing.assert_array_equal(pair.prior, prior)
    index = np.empty(n // 2, np.int64)  # of matches that are all impossible the first
    preselection.draw_by_prior(np.zeros(n), 5, 0, index)
    np.testing.assert_array_equal(index, np.arange(n // 2))


@pytest.mark.parametrize("kind", ["InlierCount", "Msac", "Magsac", "SaturatedGains"])
@pytest.mark.parametrize("given", ["scene 700", "real 7"])
def test_the_models_that_pass_are_the_best_on_few_matches(given: str, kind: str) -> None:
    score = getattr(estimators, kind)(1.5, *([True] if kind == "Msac" else []))
    pair, options = named(given, seed=SEED), estimators.Preselect(matches=64, survivors=20)
    F = models(pair, 120).astype(np.float32)
    which, scores = Preselection(score, options)(F, pair)
    by_prior = score.prior_weighted and pair.prior is not None
    draw = preselection.drawn_by_prior if by_prior else preselection.shuffled_first
    first = getattr(score, "preselection", score)(F, np.arange(120), draw(pair, 64))
    np.testing.assert_array_equal(which, np.sort(np.argsort(-first, kind="stable")[:20]))
    np.testing.assert_array_equal(scores, score(F, np.arange(120), pair)[which])


@pytest.mark.parametrize("given", ["scene 700", *FEW])
def test_all_models_are_scored_where_there_is_little_to_gain(given: str) -> None:
    """Without preselection, for no more models than pass, and for matches that are few anyway."""
    pair, score = named(given), estimators.Msac(1.5)
    F = models(pair, 30).astype(np.float32)
    few = None if pair.bucket >= 2 * 64 else estimators.Preselect(64, 20)
    for options in (None, estimators.Preselect(64, 30), estimators.Preselect(512, 20), few):
        which, scores = Preselection(score, options)(F, pair)
        np.testing.assert_array_equal(which, np.arange(30))
        np.testing.assert_array_equal(scores, score(F, np.arange(30), pair))


def reason_of(x0: np.ndarray, x1: np.ndarray, inliers: np.ndarray | None = None, dtype: type = np.float64) -> str:
    points = [torch.from_numpy(x.astype(dtype).astype(np.float64))[None] for x in (x0, x1)]
    pair = pair_of(Correspondences(*points, torch.ones(1, len(x0), dtype=torch.bool)))
    inside = np.ones(len(x0), np.bool_) if inliers is None else inliers
    return preselection.degenerate_support(pair, inside, 7, float(np.finfo(dtype).eps))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shift", [0.0, 3000.0])
@pytest.mark.parametrize("scale", SCALES)
def test_points_of_a_line_are_distinguished_from_points_near_one(scale: float, shift: float, dtype: type) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        direction, start = rng.normal(size=2), rng.uniform(0, 500, 2) + shift
        line = start + rng.uniform(-300, 300, (30, 1)) * direction / np.linalg.norm(direction)
        near = line + rng.normal(0, 0.02, (30, 2))  # px: no detector is as exact
        other = rng.uniform(0, 500, (30, 2))
        lines = {"image 0": (line, other), "image 1": (other, line), "image 0 and image 1": (line, line[::-1])}
        for images, pair in lines.items():
            said = f"the inliers of the best model lie on one line in {images}"
            assert reason_of(*(scale * x for x in pair), dtype=dtype) == said
        assert reason_of(scale * near, scale * other, dtype=dtype) == ""


@pytest.mark.parametrize("count", [0, 6, 7])
def test_inliers_count_once_at_one_place_and_late_ones_are_seen(count: int) -> None:
    x = np.random.default_rng(1).uniform(0, 500, (1000, 4))
    few = f"the best model has {count} different inliers; at least 7 are needed" if count < 7 else ""
    for first in (0, 100, preselection.FIRST_LOOK - 3, 900):
        inliers = np.zeros(1000, np.bool_)
        inliers[first : first + count] = True
        assert reason_of(x[:, :2], x[:, 2:], inliers) == few
        y = x.copy()
        y[first + count : first + count + 20] = x[first + max(count - 1, 0)]
        inliers[first + count : first + count + 20] = count > 0
        assert reason_of(y[:, :2], y[:, 2:], inliers) == few


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", ["scene 40", "scene 700", "real 7", *FEW])
def test_what_is_said_is_what_the_definition_says(name: str, scale: float) -> None:
    pair, rng = named(name, scale), np.random.default_rng(0)
    for share in (0.01, 0.1, 0.5, 1.0):
        inliers = rng.random(pair.count) < share
        reason = preselection.degenerate_support(pair, inliers, 7, EPS32)
        inside = pair.points[:, inliers].T
        largest = np.abs(pair.centre).max() / pair.pixels_per_unit + 1
        assert reason == reference.degenerate_support(inside, 7, EPS32 * largest)


def test_lines_up_to_the_rounding_of_float32_coordinates() -> None:
    """Points off a line by less than that of their extent are on it, whatever their type; by more of it not."""
    rng = np.random.default_rng(0)
    along = np.append(rng.uniform(-300, 300, 28), [-300, 300])
    other = rng.uniform(0, 500, (30, 2))
    for off, on_line in ((EPS32 / 16, True), (4 * EPS32, False)):  # of 600; the first point is as near as 300
        line = np.stack([along, 600 * off * rng.choice([-1, 1], 30)], 1)
        assert ("line in image 0" in reason_of(line, other)) == on_line


def pair(count: int, prior: str = "given") -> estimators.Pair:
    c = known(count)
    index = torch.arange(count)[None]
    priors = {
        "none": None, "zero": torch.zeros(1, count), "one certain": (index == count // 2).float(),
        "small": torch.logspace(-12, 0, count)[None], "given": c.prior,
    }  # fmt: skip
    return pair_of(c.replace(prior=priors[prior]), seed=SEED)


def numbers_of(pair: estimators.Pair, draw: int, columns: int) -> list[int]:
    return [number(pair.seed, pair.key, Stream.SAMPLING, draw, j, columns) for j in range(columns)]


@pytest.mark.parametrize("prior", ["given", "none", "zero", "one certain", "small"])
@pytest.mark.parametrize("size", [4, 5, 7, 8])
@pytest.mark.parametrize("count", [8, 9, 20, 40, 150, 700])
def test_samples_by_weight_are_those_of_the_definition(count: int, size: int, prior: str) -> None:
    matches = pair(count, prior)
    ones = [1] * count
    largest = largest_weight(matches.bucket)
    weights = ones if matches.prior is None else reference.quantised(matches.prior.tolist(), largest)
    for sampler, expected in ((estimators.PriorWeighted(), weights), (estimators.Uniform(), ones)):
        assert sampler.weight(matches).tolist() == expected
        assert sum(expected) <= 1 << 30
        for start, draws in ((0, 20), (700, 11)):
            sample = sampler.draw(matches, start, draws, size)
            assert sample.dtype == np.int64
            numbers = (numbers_of(matches, draw, size) for draw in range(start, start + draws))
            assert sample.T.tolist() == [reference.weighted_sample(expected, each) for each in numbers]


@pytest.mark.parametrize("size", [4, 5, 7, 8])
@pytest.mark.parametrize("count", [8, 9, 20, 40, 700])
def test_samples_of_prosac_are_those_of_the_definition(count: int, size: int) -> None:
    matches, sampler = pair(count), estimators.Prosac()
    exact, grown = reference.prosac_growth(count, size, sampler.GROWTH)
    table = sampler.growth(count, size).tolist()
    for n in range(1, count):  # a whole number that rounding has put above itself is rounded up to the next
        excess = table[n] - table[n - 1] - (exact[n] - exact[n - 1])
        assert excess == 0 or (excess == 1 and grown[n].denominator == 1), n
    best = np.argsort(matches.ambiguity, kind="stable")
    for start in (0, table[-1] // 2, max(table[-1] - 10, 0)):
        draws = min(20, table[-1] - start)
        counted = ((d + 1, numbers_of(matches, d, size - 1)) for d in range(start, start + draws))
        expected = [reference.prosac_sample(table, *each) for each in counted]
        np.testing.assert_array_equal(sampler.draw(matches, start, draws, size).T, best[expected])


def test_prosac_ranks_by_prior_where_there_is_no_quality() -> None:
    matches = pair_of(scene(1, 100).replace(ratio=None))
    rank = np.argsort(np.argsort(-matches.prior, kind="stable"))
    sample = rank[estimators.Prosac().draw(matches, 0, 300, 7)]
    assert sorted(sample[:, 0].tolist()) == list(range(7))
    assert (np.diff(sample.max(0)) >= 0).all()


def test_prosac_is_uniform_after_its_growth_and_where_nothing_is_ranked() -> None:
    """Without a rank the order of matches means nothing: the first half may be a part of the image."""
    matches = pair(20)
    end = int(estimators.Prosac().growth(20, 7)[-1])
    assert (estimators.Prosac().draw(matches, end - 1, 1, 7) == np.argsort(matches.ambiguity)[-1]).any()
    across = estimators.Prosac().draw(matches, end - 30, 60, 7)
    np.testing.assert_array_equal(across[:, :30], estimators.Prosac().draw(matches, end - 30, 30, 7))
    np.testing.assert_array_equal(across[:, 30:], estimators.Uniform().draw(matches, end, 30, 7))
    nothing = pair_of(scene(1, 100).replace(ratio=None, prior=None))
    drawn, uniform = (sampler.draw(nothing, 100, 300, 7) for sampler in (estimators.Prosac(), estimators.Uniform()))
    np.testing.assert_array_equal(drawn, uniform)
