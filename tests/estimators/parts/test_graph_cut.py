"""The local optimisation of Graph-Cut RANSAC: fits of its samples, and no model made worse."""

from __future__ import annotations

import numpy as np
import pytest

from fmtorch.estimators import Ransac
from fmtorch.estimators.graph_cut import FIRST_DRAW, GraphCut, neighbor_graph
from fmtorch.estimators.inliers import residuals_squared_px
from fmtorch.estimators.pair import Pair
from fmtorch.estimators.scores import Msac
from fmtorch.estimators.selection import scores_of
from fmtorch.jit.random import Stream
from tests.estimators.pairs import FEW, REAL, SCALES, models, named
from tests.reference.random import number
from tests.reference.solvers import eight_point, normalised_equations, unit

NAMES = ("scene 40", "scene 300", *REAL)


def searched(pair: Pair) -> np.ndarray:
    """The best models of a short search."""
    return Ransac(hypotheses=100, round=50, pool=4).search(pair).models


@pytest.mark.parametrize("name", NAMES)
def test_fits_are_those_of_all_inliers_and_of_samples_of_them(name: str) -> None:
    pair, part = named(name, seed=2), GraphCut(1.0, Msac(1.0))
    labels = residuals_squared_px(searched(pair)[0], pair) <= 4.0
    inliers, size = np.flatnonzero(labels), part.SAMPLE_SIZE
    assert len(inliers) >= 8
    for iteration in (0, 1):
        fits, expected, errors = part.fits(labels, pair, iteration), [inliers], []
        for s in range(part.SAMPLES):
            draw = FIRST_DRAW + iteration * part.SAMPLES + s
            words = [number(pair.seed, pair.key, Stream.SAMPLING, draw, j, size) for j in range(size)]
            expected.append(inliers[[(word >> 31) * len(inliers) >> 32 for word in words]])
        assert len(fits) == len(expected)
        for F, sample in zip(fits, expected, strict=True):
            x0, x1 = pair.points[:2, sample].T, pair.points[2:, sample].T
            s = np.linalg.svd(normalised_equations(x0, x1)[0], compute_uv=False)
            # Of the products of the equations: sums of up to 1000 terms, an eigenvector that is apart by s8^2 - s9^2;
            # and two changes of units of a size of 10 at most.
            error = 1000 * 10 * 2.0**-53 * s[0] ** 2 / (s[7] ** 2 - s[8] ** 2)
            errors.append(error)
            assert np.abs(unit(F.reshape(3, 3)) - eight_point(x0, x1)).max() < error or error > 0.1
        assert np.median(errors) < 1e-4  # few samples hold too few different matches
    assert len(part.fits(np.zeros(pair.count, np.bool_), pair, 0)) == 0


@pytest.mark.parametrize("name", NAMES)
def test_no_model_is_made_worse_and_most_are_made_better(name: str) -> None:
    pair, score = named(name), Msac(1.0)
    F = np.vstack([searched(pair), np.random.default_rng(0).normal(size=(4, 9))])  # nonsense, which must not either
    before, after = (scores_of(score, x, pair) for x in (F, GraphCut(1.0, score)(F, pair)))
    assert (after >= before).all()
    assert (after > before).sum() >= 2


def test_a_model_is_its_best_fit_as_long_as_the_score_rises() -> None:
    """Algorithm 2 of the paper, with at most ITERATIONS rounds."""
    rounds = []
    for name in ("scene 100", "scene 300", *REAL):
        pair, part = named(name), GraphCut(1.0, Msac(1.0))
        graph, F = neighbor_graph(pair, part.RADIUS_PX), searched(pair)
        F = np.vstack([F, part(F, pair)])  # those that are good already
        for start, improved in zip(F, part(F, pair), strict=True):
            path = [(scores_of(part.score, start[None], pair)[0], start)]
            for iteration in range(part.ITERATIONS + 1):
                models = part.fits(part.labels(path[-1][1], pair, graph), pair, iteration)
                scores = scores_of(part.score, models, pair)
                path.append((scores.max(), models[scores.argmax()]))
                if path[-1][0] <= path[-2][0]:
                    break
            rising = [F for k, (score, F) in enumerate(path) if k == 0 or score > path[k - 1][0]]
            rounds.append(len(rising) - 1)
            np.testing.assert_array_equal(improved, rising[min(part.ITERATIONS, rounds[-1])])
    assert min(rounds) < GraphCut.ITERATIONS < max(rounds)  # some stop by themselves, others could go on


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", FEW)
def test_few_matches_and_any_model(name: str, scale: float) -> None:
    pair, part = named(name, scale), GraphCut(1.0, Msac(1.0))
    F = np.vstack([np.zeros(9), np.ones(9), models(pair, 7)[1:]])
    improved = part(F, pair)
    assert np.isfinite(improved).all()
    assert (scores_of(part.score, improved, pair) >= scores_of(part.score, F, pair)).all()


def test_models_without_inliers_are_kept() -> None:
    nowhere = np.zeros((1, 9))
    nowhere[0, 8] = 1  # no point lies on its epipolar line
    np.testing.assert_array_equal(GraphCut(1.0, Msac(1.0))(nowhere, named("scene 40")), nowhere)


def test_unknown_local_optimization_is_told() -> None:
    with pytest.raises(ValueError, match="local_optimization is 'x'; it must be one of: graph_cut"):
        Ransac(local_optimization="x")
