"""Which models are scored on all matches, and on which few matches they are compared before."""

from typing import Any

import numpy as np
import pytest
import torch

from fmtorch.core import Correspondences
from fmtorch.estimators import InlierCount, Magsac, Msac, Pair, Preselect, SaturatedGains
from fmtorch.estimators.preselection import (
    FIRST_LOOK,
    Preselection,
    best,
    degenerate_support,
    draw_by_prior,
    drawn_by_prior,
    shuffled_first,
)
from fmtorch.jit.random import Stream
from tests.estimators.pairs import FEW, SCALES, models, named, pair_of
from tests.reference import ransac as reference
from tests.reference.random import number
from tests.reference.ransac import degenerate_support as expected_support

SEED = 3


def numbers(pair: Pair) -> list[int]:
    return [number(pair.seed, pair.key, Stream.PRESELECTION, 0, i, 1) for i in range(pair.count)]


@pytest.mark.parametrize("given", ["scene 40", "scene 129", "scene 700", "7 random", "20 collinear"])
def test_few_matches_are_those_of_the_definitions(given: str) -> None:
    pair = named(given, seed=SEED)
    n, words, prior = pair.count, numbers(pair), pair.prior.copy()
    for count in (1, 5, n - 1, n, 2 * n):
        any_few, likely = shuffled_first(pair, count), drawn_by_prior(pair, count)
        np.testing.assert_array_equal(any_few.table, pair.table[:, reference.shuffled(range(n), words, count)])
        drawn = reference.priority_sample(prior.tolist(), words, count)
        np.testing.assert_array_equal(likely.points, pair.points[:, drawn])
        np.testing.assert_array_equal(likely.match_weight, prior[drawn] > 0)
    np.testing.assert_array_equal(pair.prior, prior)


def test_likely_matches_are_drawn_by_their_prior() -> None:
    """Three times as many of the kind three times as likely, and none that have no prior."""
    n, k, seen, keys = 900, 60, np.zeros(3), 300
    prior = np.repeat([0.0, 0.2, 0.6], n // 3)
    index = np.empty(k, np.int64)
    for key in range(keys):
        draw_by_prior(prior, 5, key, index)
        assert len(set(index.tolist())) == k
        seen += np.bincount(index // (n // 3), minlength=3)
    assert seen[0] == 0
    # 60 of 600 at a time: by their prior up to some 2 % (those drawn are missing later); 5 standard errors of a share.
    assert seen[2] / seen.sum() == pytest.approx(0.75, abs=0.02 + 5 * np.sqrt(0.75 * 0.25 / (k * keys)))
    draw_by_prior(np.zeros(n), 5, 0, index)
    np.testing.assert_array_equal(index, np.arange(k))


@pytest.mark.parametrize(("m", "k"), [(1, 1), (5, 5), (300, 96), (300, 1), (1000, 256)])
def test_the_best_of_a_round_and_the_first_of_equals(m: int, k: int) -> None:
    score = np.random.default_rng(m + k).integers(0, 40, m) / 8.0
    score[::7] = -np.inf
    which = np.empty(k, np.int64)
    best(score, which)
    np.testing.assert_array_equal(which, np.sort(np.argsort(-score, kind="stable")[:k]))


@pytest.mark.parametrize("score", [InlierCount(1.5), Msac(1.5, True), Magsac(1.5), SaturatedGains(1.5)])
@pytest.mark.parametrize("given", ["scene 700", "real 7"])
def test_the_models_that_pass_are_the_best_on_few_matches(given: str, score: Any) -> None:
    pair, options = named(given, seed=SEED), Preselect(matches=64, survivors=20)
    F = models(pair, 120).astype(np.float32)
    which, scores = Preselection(score, options)(F, pair)
    draw = drawn_by_prior if score.prior_weighted and pair.prior is not None else shuffled_first
    first = getattr(score, "preselection", score)(F, np.arange(120), draw(pair, 64))
    np.testing.assert_array_equal(which, np.sort(np.argsort(-first, kind="stable")[:20]))
    np.testing.assert_array_equal(scores, score(F, np.arange(120), pair)[which])


@pytest.mark.parametrize("given", ["scene 700", *FEW])
def test_all_models_are_scored_where_there_is_little_to_gain(given: str) -> None:
    """Without preselection, for no more models than pass, and for matches that are few anyway."""
    pair, score = named(given), Msac(1.5)
    F = models(pair, 30).astype(np.float32)
    few = None if pair.bucket >= 2 * 64 else Preselect(64, 20)
    for options in (None, Preselect(64, 30), Preselect(512, 20), few):
        which, scores = Preselection(score, options)(F, pair)
        np.testing.assert_array_equal(which, np.arange(30))
        np.testing.assert_array_equal(scores, score(F, np.arange(30), pair))


EPS32 = 2.0**-23


def reason_of(x0: np.ndarray, x1: np.ndarray, inliers: np.ndarray | None = None, dtype: type = np.float64) -> str:
    """What is said of a pair of these matches."""
    points = [torch.from_numpy(x.astype(dtype).astype(np.float64))[None] for x in (x0, x1)]
    pair = pair_of(Correspondences(*points, torch.ones(1, len(x0), dtype=torch.bool)))
    inside = np.ones(len(x0), np.bool_) if inliers is None else inliers
    return degenerate_support(pair, inside, 7, float(np.finfo(dtype).eps))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shift", [0.0, 3000.0])
@pytest.mark.parametrize("scale", SCALES)
def test_points_of_a_line_are_told_from_points_near_one(scale: float, shift: float, dtype: type) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        direction, start = rng.normal(size=2), rng.uniform(0, 500, 2) + shift
        line = start + rng.uniform(-300, 300, (30, 1)) * direction / np.linalg.norm(direction)
        near = line + rng.normal(0, 0.02, (30, 2))  # px: no detector is as exact
        other = rng.uniform(0, 500, (30, 2))
        for x0, x1, images in (
            (line, other, "image 0"),
            (other, line, "image 1"),
            (line, line[::-1], "image 0 and image 1"),
            (near, other, ""),
        ):
            expected = f"the inliers of the best model lie on one line in {images}" if images else ""
            assert reason_of(scale * x0, scale * x1, dtype=dtype) == expected


@pytest.mark.parametrize("count", [0, 6, 7])
def test_inliers_count_once_at_one_place_and_late_ones_are_seen(count: int) -> None:
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 500, (1000, 4))
    few = f"the best model has {count} different inliers; at least 7 are needed" if count < 7 else ""
    for first in (0, 100, FIRST_LOOK - 3, 900):
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
        reason = degenerate_support(pair, inliers, 7, EPS32)
        inside = pair.points[:, inliers].T
        largest = np.abs(pair.centre).max() / pair.pixels_per_unit + 1
        assert reason == expected_support(inside, 7, EPS32 * largest)


def test_lines_up_to_the_rounding_of_float32_coordinates() -> None:
    """Points off a line by less than that of their extent are on it, whatever their type; by more of it not."""
    rng = np.random.default_rng(0)
    along = np.append(rng.uniform(-300, 300, 28), [-300, 300])
    other = rng.uniform(0, 500, (30, 2))
    for off, on_line in ((EPS32 / 16, True), (4 * EPS32, False)):  # of 600; the first point is as near as 300
        line = np.stack([along, 600 * off * rng.choice([-1, 1], 30)], 1)
        assert ("line in image 0" in reason_of(line, other)) == on_line
