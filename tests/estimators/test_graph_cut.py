"""The local optimisation of Graph-Cut RANSAC: fits of its samples, and no model made worse."""

import functools

import numpy as np
import pytest

from fmtorch.estimators import GraphCut, Msac, Pair, Ransac
from fmtorch.estimators.graph_cut import (
    FIRST_DRAW,
    HALVINGS,
    MAX_NEIGHBOURS,
    SWEEPS,
    UNIT,
    Graph,
    _gaussian,
    label,
    neighbor_graph,
)
from fmtorch.estimators.inliers import residuals_squared_px
from fmtorch.estimators.selection import scores_of
from fmtorch.jit.kernel import F4x1, F8x1, F8x2, kernel
from fmtorch.jit.random import Stream
from tests.conftest import oracle
from tests.estimators.pairs import FEW, REAL, models, named, to_units
from tests.reference import ransac as reference
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


RADIUS = 20.0
RECTIFIED = np.array([0, 0, 0, 0, 0, 1.0, 0, -1, 0])  # r^2 = (y1 - y0)^2 / 2


@kernel
def gaussian(F: F8x1, points: F8x2, scale: float, K: F4x1) -> None:
    """The kernel of residuals."""
    _gaussian(F, points, scale, K)


def edges_of(graph: Graph) -> list[tuple[int, int]]:
    """Each edge once; it is known to both of its ends."""
    ends = {(i, int(j)) for i, d in enumerate(graph.degree) for j in graph.neighbours[i, :d]}
    assert len(ends) == graph.degree.sum()
    assert {(j, i) for i, j in ends} == ends
    return sorted((i, j) for i, j in ends if i < j)


def graph_of(n: int, edges: list[tuple[int, int]]) -> Graph:
    graph = Graph(np.zeros((n, MAX_NEIGHBOURS), np.int32), np.zeros(n, np.int32))
    for p, q in edges:
        for i, j in ((p, q), (q, p)):
            graph.neighbours[i, graph.degree[i]] = j
            graph.degree[i] += 1
    return graph


def rectified(z: np.ndarray) -> np.ndarray:
    """Points (4, n) with squared residuals z under RECTIFIED."""
    return np.stack([0 * z, 0 * z, 0 * z, np.sqrt(2 * z)])


@functools.cache
def given(name: str) -> tuple[Pair, np.ndarray]:
    """A real pair, and a model in its units from a robust estimator (OpenCV's USAC_MAGSAC)."""
    pair, F = named(name), oracle("robust.npz")[f"{int(name.split()[1]):03d}.cv2_USAC_MAGSAC.F"][0]
    return pair, to_units(F, pair)


def distances(pair: Pair) -> np.ndarray:
    """Between all matches in (x0, y0, x1, y1), px."""
    return np.linalg.norm((pair.points[:, :, None] - pair.points[:, None]) * pair.pixels_per_unit, axis=0)


@pytest.mark.parametrize("name", REAL)
def test_neighbours_are_within_the_radius_and_nearly_all_of_those(name: str) -> None:
    pair, _ = given(name)
    edges, apart = edges_of(neighbor_graph(pair, RADIUS)), distances(pair)
    assert all(apart[p, q] <= RADIUS * (1 + 1e-12) for p, q in edges)
    assert len(edges) > 0.95 * np.count_nonzero(np.triu(apart <= RADIUS, 1))  # SHIFTS: the two curves find 97 %


def test_the_kernel_is_the_gaussian() -> None:
    z, K = np.linspace(0, 60, 5001), np.empty(5001, np.float32)
    gaussian(RECTIFIED, rectified(z), 1.0, K)
    # exp(-z) - (1 + z / n)^-n is z^2 exp(-z) / (2 n) at most, 0.27 / n; half a unit of rounding, and 1024 roundings.
    assert np.abs(K - np.exp(-z / 2)).max() < (0.28 / 2**HALVINGS) + UNIT / 2 + 2**HALVINGS * 2.0**-24
    np.testing.assert_array_equal(K / UNIT, np.round(K / UNIT))


def test_the_reference_cut_finds_the_least_energy() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 2, 5, 9):
        for coherence in (0.1, 0.7, 2.0):
            K = rng.random(n)
            edges = [(p, q) for q in range(n) for p in range(q) if rng.random() < 0.5]
            min_energy = reference.least_by_enumeration(K, edges, coherence)
            labels = reference.least_cut(K, edges, coherence)
            # Each capacity is off by half a unit at most; a labelling meets n + edges of them, the best one too.
            tolerance = (n + len(edges)) * reference.CAPACITY_UNIT
            assert reference.energy(labels, K, edges, coherence) <= min_energy + tolerance


@pytest.mark.parametrize("coherence", [0.125, 0.5, 1.0])  # exact, so that ties are ties
def test_labels_on_random_graphs(coherence: float) -> None:
    """The better one of two fixed points, which enclose the least cut."""
    rng = np.random.default_rng(1)
    for n in (1, 3, 8, 12):
        for density in (0.1, 0.4, 0.8):
            edges = [(p, q) for q in range(n) for p in range(q) if rng.random() < density]
            wanted = rng.integers(1, 1025, n) / 1024
            points, K, labelled = (
                rectified(2 * 1024 * (wanted ** (-1 / 1024) - 1)),
                np.empty(n, np.float32),
                np.empty(n, np.bool_),
            )
            gaussian(RECTIFIED, points, 1.0, K)
            np.testing.assert_array_equal(K, wanted)
            label(RECTIFIED, points, 1.0, graph_of(n, edges), coherence, labelled)
            low, high = (reference.fixed_point(wanted, edges, coherence, start, SWEEPS) for start in (0, 1))
            cut = reference.least_cut(wanted, edges, coherence)
            assert (low <= cut).all()
            assert (cut <= high).all()
            energies = [reference.energy(labels, wanted, edges, coherence) for labels in (low, high)]
            np.testing.assert_array_equal(labelled, low if energies[0] <= energies[1] else high)


@pytest.mark.parametrize(("epsilon", "coherence"), [(0.31, 0.1), (1.5, 0.1), (1.0, 0.5)])
def test_labels_are_almost_those_of_the_exact_cut_on_real_pairs(epsilon: float, coherence: float) -> None:
    same, excess = [], []
    for name in REAL:
        pair, F = given(name)
        graph, scale = neighbor_graph(pair, RADIUS), (pair.pixels_per_unit / epsilon) ** 2
        K, labels = np.empty(pair.count, np.float32), np.empty(pair.count, np.bool_)
        gaussian(F, pair.points, scale, K)
        label(F, pair.points, scale, graph, coherence, labels)
        exact, edges = K.astype(np.float64), edges_of(graph)
        cut = reference.least_cut(exact, edges, coherence)
        assert 0 < cut.mean() < 1
        min_energy = reference.energy(cut, exact, edges, coherence)
        same.append(np.mean(labels == cut))
        excess.append(reference.energy(labels, exact, edges, coherence) / min_energy - 1)
    # Where the two bounds meet the labels are the cut's; what is asked here is that they meet nearly everywhere.
    assert np.mean(same) > 0.999
    assert min(same) > 0.995
    assert np.mean(excess) < 1e-3


@pytest.mark.parametrize("name", FEW)
def test_a_model_of_all_matches_has_all_labels_and_one_of_none_has_none(name: str) -> None:
    pair = named(name)
    graph, labels = neighbor_graph(pair, RADIUS), np.empty(pair.count, np.bool_)
    label(models(pair, 2)[1], pair.points, 1e-30, graph, 0.1, labels)
    assert labels.all()
    label(np.array([0, 0, 0, 0, 0, 0, 0, 0, 1.0]), pair.points, 1.0, graph, 0.1, labels)  # no point is on its line
    assert not labels.any()
