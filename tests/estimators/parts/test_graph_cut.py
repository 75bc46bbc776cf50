"""The labelling of GC-RANSAC against the exact cut, and a local optimisation that never makes a model worse."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from fmtorch.core.types import Correspondences
from fmtorch.estimators import HypothesizeAndVerify, Pair
from fmtorch.estimators.families.fundamental import SevenPoint
from fmtorch.estimators.parts.graph_cut import GraphCut
from fmtorch.estimators.parts.inliers import residuals_squared_px
from fmtorch.estimators.parts.neighbours import MAX_NEIGHBOURS, Graph, label, neighbor_graph
from fmtorch.estimators.parts.preselection import Preselection
from fmtorch.estimators.parts.sampling import Uniform
from fmtorch.estimators.parts.scores import Msac
from fmtorch.estimators.parts.selection import scores_of
from fmtorch.estimators.search import Search
from fmtorch.geometry.eight_point_kernels import weighted_eight_point
from tests.conftest import oracle
from tests.estimators.pairs import apart, pair_of, to_units
from tests.laws import SMALL_KINDS, scene, small
from tests.reference import graph_cut as reference

RADIUS = 20.0
RECTIFIED = np.array([0, 0, 0, 0, 0, -1, 0, 1, 0.0])  # y1 = y0: squared Sampson distances are half of (y1 - y0)^2
ROUNDED = 2.0**-10  # of kernels


def real(i: int) -> tuple[Pair, np.ndarray]:
    """Real matches, and a model (9,) of them by a robust estimator (OpenCV's USAC_MAGSAC)."""
    arrays = oracle("robust.npz")
    x0, x1 = (torch.from_numpy(arrays[f"{i:03d}.{name}"])[None] for name in ("X1", "X2"))
    pair = pair_of(Correspondences(x0, x1, torch.ones(x0.shape[:2], dtype=torch.bool), key=torch.tensor([i])))
    return pair, to_units(arrays[f"{i:03d}.cv2_USAC_MAGSAC.F"][0], pair)


def edges_of(graph: Graph) -> list[tuple[int, int]]:
    """The undirected edges of a graph, each of which it holds from both ends."""
    directed = {(i, int(j)) for i in range(len(graph.degree)) for j in graph.neighbours[i, : graph.degree[i]]}
    assert len(directed) == graph.degree.sum()
    assert {(j, i) for i, j in directed} == directed
    return sorted((i, j) for i, j in directed if i < j)


def graph_of(n: int, edges: list[tuple[int, int]]) -> Graph:
    graph = Graph(np.zeros((n, MAX_NEIGHBOURS), np.int32), np.zeros(n, np.int32))
    for p, q in [*edges, *((q, p) for p, q in edges)]:
        graph.neighbours[p, graph.degree[p]] = q
        graph.degree[p] += 1
    return graph


def labels_of(F: np.ndarray, points: np.ndarray, scale: float, graph: Graph, coherence: float) -> np.ndarray:
    labels = np.empty(points.shape[1], np.bool_)
    label(F, points, scale, graph, coherence, labels)
    return labels


def test_the_reference_cut_has_the_least_energy() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 2, 5, 9):
        for coherence in (0.1, 0.7, 2.0):
            kernel = rng.random(n)
            edges = [(p, q) for q in range(n) for p in range(q) if rng.random() < 0.5]
            least = reference.least_by_enumeration(kernel, edges, coherence)
            labels = reference.least_cut(kernel, edges, coherence)
            # Each capacity is off by half a unit at most; a labelling meets n + edges of them, the best one too.
            tolerance = (n + len(edges)) * reference.CAPACITY_UNIT
            assert reference.energy(labels, kernel, edges, coherence) <= least + tolerance


@pytest.mark.parametrize("coherence", [0.1, 0.5, 1.0])
def test_labels_on_random_graphs(coherence: float) -> None:
    """At most as much energy as any labelling near, and where neighbours do not matter the least."""
    rng, excess, exact = np.random.default_rng(1), [], 0
    for n in [3, 8, 12] * 20:
        edges = [(p, q) for q in range(n) for p in range(q) if rng.random() < 0.4]
        K = rng.integers(1, 1025, n) / 1024
        points = np.zeros((4, n))
        points[3] = np.sqrt(-4 * np.log(K))  # of the kernel K at epsilon 1
        labels = labels_of(RECTIFIED, points, 1.0, graph_of(n, edges), coherence)
        least = reference.energy(reference.least_cut(K, edges, coherence), K, edges, coherence)
        found = reference.energy(labels, K, edges, coherence)
        assert found >= least - (n + len(edges)) * reference.CAPACITY_UNIT
        everything = min(reference.energy(np.full(n, x), K, edges, coherence) for x in (False, True))
        # Kernels are off by half a unit, and by 0.28 / 1024 of the approximated exponential.
        assert found <= everything + (n + len(edges)) * ROUNDED
        excess.append(found / max(least, 0.1) - 1)
        exact += found <= least + (n + len(edges)) * ROUNDED
        alone = labels_of(RECTIFIED, points, 1.0, graph_of(n, []), coherence)
        clear = np.abs(K - 0.5) > ROUNDED
        np.testing.assert_array_equal(alone[clear], K[clear] > 0.5)
    assert exact > 0.7 * len(excess)
    assert np.mean(excess) < 0.02


@pytest.mark.parametrize(("epsilon", "coherence"), [(0.31, 0.1), (1.5, 0.1), (1.0, 0.5)])
def test_labels_are_almost_those_of_the_exact_cut_on_real_pairs(epsilon: float, coherence: float) -> None:
    same, excess = [], []
    for i in range(0, len(oracle("robust.npz")["names"]), 2):
        pair, F = real(i)
        graph = neighbor_graph(pair, RADIUS)
        labels = labels_of(F, pair.points, (pair.pixels_per_unit / epsilon) ** 2, graph, coherence)
        K, edges = np.exp(-residuals_squared_px(F, pair) / epsilon**2 / 2), edges_of(graph)
        cut = reference.least_cut(K, edges, coherence).astype(bool)
        least = reference.energy(cut, K, edges, coherence)
        same.append(np.mean(labels == cut))
        excess.append(reference.energy(labels, K, edges, coherence) / least - 1)
    # The labels are the cut's where the bounds of it meet, which is nearly everywhere.
    assert np.mean(same) > 0.999
    assert min(same) > 0.995
    assert np.mean(excess) < 1e-3


def test_neighbors_are_within_the_radius_and_nearly_all_of_those() -> None:
    connected = near = 0
    for i in range(0, len(oracle("robust.npz")["names"]), 2):
        pair, _ = real(i)
        edges = edges_of(neighbor_graph(pair, RADIUS))
        points = (pair.points * pair.pixels_per_unit).T
        distance = np.linalg.norm(points[:, None] - points[None], axis=2)
        assert all(distance[p, q] <= RADIUS * (1 + 1e-12) for p, q in edges)
        connected += len(edges)
        near += (int((distance <= RADIUS).sum()) - len(points)) // 2
    assert connected > 0.95 * near


def test_fits_are_those_of_all_inliers_and_of_samples_of_them() -> None:
    pair = pair_of(scene(1, 200))
    part = GraphCut(1.0, Msac(1.0))
    labels = np.arange(200) % 3 == 0
    models = part.fits(labels, pair, 0)
    assert len(models) == part.SAMPLES + 1
    whole = np.empty(9)
    inliers = np.ascontiguousarray(pair.points[:, labels])
    assert weighted_eight_point(inliers, np.ones(inliers.shape[1]), whole)
    assert apart(models[0], whole) < 1e-12
    assert len(np.unique(models, axis=0)) == len(models)
    assert not np.array_equal(part.fits(labels, pair, 1)[1:], models[1:])  # other draws
    exact = pair_of(scene(2, 200, outliers=0.0, noise=0.0))
    exact_models = part.fits(labels, exact, 0)
    # Points are float32: 1e-7 of the unit, times the condition of a sample of 49.
    assert max(apart(F, exact_models[0]) for F in exact_models) < 1e-4
    assert len(part.fits(np.zeros(200, np.bool_), pair, 0)) == 0


def test_no_score_falls_and_most_rise() -> None:
    rng, score = np.random.default_rng(0), Msac(1.0)
    for i in range(4):
        pair = pair_of(scene(i, 300, noise=0.5))
        found = Search(SevenPoint(), Uniform(), Preselection(score, None), 1, 200, 200)(pair)
        F = np.vstack([found.models, rng.normal(size=(5, 9))])  # nonsense must not get worse either
        improved = GraphCut(1.0, score)(F, pair)
        before, after = (scores_of(score, models, pair) for models in (F, improved))
        assert (after >= before).all()
        assert after[0] > before[0]


@pytest.mark.parametrize("kind", ["random", *SMALL_KINDS[:3], "half coincident"])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_few_matches_and_any_model(kind: str, scale: float) -> None:
    """Nothing raises; no model becomes worse; those that are finite stay so."""
    part = GraphCut(1.0, Msac(1.0))
    for count in (8, 20):
        c = small()[f"{count} {kind}"]
        pair = pair_of(c.replace(x0=scale * c.x0, x1=scale * c.x1))
        F = np.vstack([np.zeros(9), np.ones(9), np.random.default_rng(0).normal(size=(6, 9))])
        improved = part(F, pair)
        assert np.isfinite(improved).all()
        assert (scores_of(part.score, improved, pair) >= scores_of(part.score, F, pair)).all()


def test_models_without_inliers_are_kept() -> None:
    pair, nowhere = pair_of(scene(0, 40)), np.eye(9)[8:]  # no point lies on its epipolar line
    np.testing.assert_array_equal(GraphCut(1.0, Msac(1.0))(nowhere, pair), nowhere)


def test_the_kernel_is_the_gaussian() -> None:
    """Labels of matches without neighbours change where it is one half."""
    half = math.sqrt(4 * math.log(2))
    points = np.zeros((4, 2000))
    points[3] = np.linspace(0.9, 1.1, 2000) * half
    labels = labels_of(RECTIFIED, points, 1.0, graph_of(2000, []), 0.1)
    K = np.exp(-(points[3] ** 2) / 4)
    # exp(-z) - (1 + z / n)^-n is 0.27 / n at most; half a unit of rounding and float32 to the power 1024 on top.
    clear = np.abs(K - 0.5) > 0.28 / 1024 + 0.5 / 1024 + 1e-4
    np.testing.assert_array_equal(labels[clear], K[clear] > 0.5)
    assert clear.mean() > 0.9


def test_unknown_local_optimization_is_refused() -> None:
    with pytest.raises(ValueError, match="local_optimization is 'x'; it must be one of: graph_cut"):
        HypothesizeAndVerify(local_optimization="x")
