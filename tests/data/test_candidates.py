"""Which pairs are looked at, against slow counting."""

import itertools

import numpy as np
import pytest

from fmtorch.data.scenes import AllPairs, drawn, following, sharing_points


@pytest.mark.parametrize("n", [0, 1, 2, 7])
def test_all_pairs_are_all_combinations_in_order(n: int) -> None:
    pairs = AllPairs(n)
    expected = list(itertools.combinations(range(n), 2))
    assert len(pairs) == len(expected)
    assert [tuple(p) for p in pairs.at(np.arange(len(pairs)))] == expected


def test_all_pairs_of_a_million_images_are_not_listed() -> None:
    pairs = AllPairs(1_000_000)
    assert len(pairs) == 499_999_500_000
    assert pairs.at(np.array([0, 999_999, len(pairs) - 1])).tolist() == [[0, 1], [1, 2], [999_998, 999_999]]
    ranks = np.asarray(drawn(len(pairs), 1000, seed=0))
    assert len(set(ranks.tolist())) == 1000
    assert (np.diff(pairs.at(ranks)) > 0).all()


@pytest.mark.parametrize("window", [0.0, 0.35, 100.0])
def test_following_frames_are_those_within_the_window(window: float) -> None:
    times = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.2, 60))
    expected = [(i, j) for i, j in itertools.combinations(range(60), 2) if times[j] - times[i] <= window]
    pairs = following(times, window)
    assert [tuple(p) for p in pairs.at(np.arange(len(pairs)))] == expected


@pytest.mark.parametrize("minimum", [1, 5])
def test_images_that_share_points_are_those_counted_one_by_one(minimum: int) -> None:
    rng = np.random.default_rng(1)
    points = [rng.integers(0, 60, rng.integers(0, 25)) for _ in range(40)]
    points[4], points[7] = rng.integers(0, 2**40, 3).repeat(2), np.zeros(0, np.int64)
    expected = [
        (i, j)
        for i, j in itertools.combinations(range(40), 2)
        if len(set(points[i].tolist()) & set(points[j].tolist())) >= minimum
    ]
    pairs = sharing_points(points, minimum)
    assert [tuple(p) for p in pairs.pairs.tolist()] == expected
    assert len(expected) > 50
    assert len(sharing_points([])) == 0
