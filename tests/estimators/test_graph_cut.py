"""The labelling of GC-RANSAC against the exact cut, and a local optimisation that never makes a model worse."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.core.types import Correspondences, collate
from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.graph_cut import GraphCut
from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs
from fmtorch.estimators.scores import TruncatedSquares, score_models
from fmtorch.estimators.spatial import (
    NeighborGraph,
    energy,
    field,
    fixed_points,
    gaussian_kernel,
    neighbor_graph,
    spatially_coherent_inliers,
)
from fmtorch.geometry.residuals import sampson_squared
from tests.conftest import oracle
from tests.laws import scene
from tests.reference import graph_cut

RADIUS = 20.0


def _problem(c: Correspondences) -> NormalizedPairs:
    return normalized_pairs(c, 0, 7)[0][0]


def _edges(graph: NeighborGraph, n: int, pair: int = 0) -> list[tuple[int, int]]:
    """The undirected edges of one pair."""
    edges = zip((graph.head - pair * n).tolist(), (graph.tail - pair * n).tolist(), strict=True)
    return [(p, q) for p, q in edges if 0 <= p < q < n]


def _random_graph(n: int, edges: list[tuple[int, int]]) -> NeighborGraph:
    head = torch.tensor([p for p, q in edges] + [q for p, q in edges], dtype=torch.int64)
    tail = torch.tensor([q for p, q in edges] + [p for p, q in edges], dtype=torch.int64)
    return NeighborGraph(head, tail, torch.bincount(head, minlength=n)[None].to(torch.float32))


def _real() -> list[tuple[NormalizedPairs, Tensor, str]]:
    """Real matches with squared residuals, px^2, under models from a robust estimator (OpenCV's USAC_MAGSAC)."""
    arrays = oracle("robust.npz")
    found = []
    for i in range(0, len(arrays["names"]), 2):
        x0, x1 = (torch.from_numpy(arrays[f"{i:03d}.{name}"])[None] for name in ("X1", "X2"))
        problem = _problem(Correspondences(x0, x1, torch.ones(x0.shape[:2], dtype=torch.bool)))
        F = torch.from_numpy(arrays[f"{i:03d}.cv2_USAC_MAGSAC.F"][0]).reshape(9, 1, 1)
        pixels = torch.where(problem.mask, problem.points * problem.pixels_per_unit + problem.centre.T[..., None], 0)
        found.append((problem, sampson_squared(F, pixels), str(arrays["names"][i])))
    return found


def test_the_reference_cut_finds_the_least_energy() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 2, 5, 9):
        for coherence in (0.1, 0.7, 2.0):
            kernel = rng.random(n)
            edges = [(p, q) for q in range(n) for p in range(q) if rng.random() < 0.5]
            least = graph_cut.least_by_enumeration(kernel, edges, coherence)
            labels = graph_cut.least_cut(kernel, edges, coherence)
            # Each capacity is off by half a unit at most; a labelling meets n + edges of them, the best one too.
            tolerance = (n + len(edges)) * graph_cut.CAPACITY_UNIT
            assert graph_cut.energy(labels, kernel, edges, coherence) <= least + tolerance


@pytest.mark.parametrize("coherence", [0.1, 0.5, 1.0])
def test_energy_and_bounds_on_random_graphs(coherence: float) -> None:
    rng = np.random.default_rng(1)
    for n in (3, 8, 12):
        edges = [(p, q) for q in range(n) for p in range(q) if rng.random() < 0.4]
        graph, live = _random_graph(n, edges), torch.ones(1, n, dtype=torch.bool)
        kernel = torch.from_numpy(rng.integers(0, 1025, (1, 4, n)) / 1024).to(torch.float32)
        inner, outer = fixed_points(field(kernel, live, graph, coherence), graph, coherence, sweeps=n)
        labels = spatially_coherent_inliers(kernel, live, graph, coherence)
        energies = energy(labels, kernel, live, graph, coherence)[0]
        for K, low, high, found, value in zip(
            kernel[0].double().numpy(), inner[0], outer[0], labels[0], energies, strict=True
        ):
            # Sums of multiples of 2^-10 times lambda, in float64: rounding alone.
            assert float(value) == pytest.approx(graph_cut.energy(found.numpy(), K, edges, coherence), abs=1e-6)
            cut = torch.from_numpy(graph_cut.least_cut(K, edges, coherence)).bool()
            assert bool((low <= cut).all())
            assert bool((cut <= high).all())


@pytest.mark.parametrize(("epsilon", "coherence"), [(0.31, 0.1), (1.5, 0.1), (1.0, 0.5)])
def test_labels_are_almost_those_of_the_exact_cut_on_real_pairs(epsilon: float, coherence: float) -> None:
    same, excess = [], []
    for problem, r2, name in _real():
        graph = neighbor_graph(problem, RADIUS)
        n = int(problem.count)
        edges = _edges(graph, problem.mask.shape[1])
        kernel = gaussian_kernel(r2 / epsilon**2)
        labels = spatially_coherent_inliers(kernel, problem.mask, graph, coherence)
        inner, outer = fixed_points(field(kernel, problem.mask, graph, coherence), graph, coherence)
        K, found = kernel[0, 0, :n].double().numpy(), labels[0, 0, :n].numpy()
        cut = graph_cut.least_cut(K, edges, coherence).astype(bool)
        least = graph_cut.energy(cut, K, edges, coherence)
        assert bool((inner[0, 0, :n].numpy() <= cut).all()), name
        assert bool((cut <= outer[0, 0, :n].numpy()).all()), name
        same.append(np.mean(found == cut))
        excess.append(graph_cut.energy(found, K, edges, coherence) / least - 1)
    # Where the two bounds meet the labels are the cut's; what is asked here is that they meet nearly everywhere.
    assert np.mean(same) > 0.999
    assert min(same) > 0.995
    assert np.mean(excess) < 1e-3


def test_neighbors_are_within_the_radius_and_nearly_all_of_those() -> None:
    found = there = 0
    for problem, _, _ in _real():
        n = problem.mask.shape[1]
        graph = neighbor_graph(problem, RADIUS)
        edges = _edges(graph, n)
        assert 2 * len(edges) == len(graph.head)
        assert len(set(edges)) == len(edges)
        points = (problem.points * problem.pixels_per_unit)[:, 0].T[: int(problem.count)]
        distance = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
        assert all(float(distance[p, q]) <= RADIUS * (1 + 1e-12) for p, q in edges)
        found += len(edges)
        there += (int((distance <= RADIUS).sum()) - len(points)) // 2
    assert found > 0.95 * there


def test_kernel_is_the_gaussian() -> None:
    z = torch.linspace(0, 60, 5001, dtype=torch.float64)
    # exp(-z) - (1 + z / n)^-n is z^2 exp(-z) / (2 n) at most, 0.27 / n; half a unit of rounding comes on top.
    error = (gaussian_kernel(z) - torch.exp(-z / 2)).abs().max()
    assert float(error) < 0.28 / 1024 + 0.5 / 1024 + 1e-4  # float32 raised to the power of 1024: 1024 * 6e-8


def test_local_optimization_never_lowers_a_score_and_raises_most() -> None:
    pairs = collate([scene(i, 300, outliers=0.4, noise=0.5) for i in range(4)])
    problem = _problem(pairs)
    rng = np.random.default_rng(0)
    score = TruncatedSquares(1.0)
    sample = torch.from_numpy(rng.standard_normal((9, 4, 6)))  # nonsense, which must not get worse either
    models = HypothesizeAndVerify(hypotheses=200, final="none")(pairs).F
    A = torch.zeros(2, 4, 3, 3, dtype=torch.float64)
    for image, T in enumerate(A):
        T[:, 0, 0] = T[:, 1, 1] = problem.pixels_per_unit
        T[:, :2, 2] = problem.centre[:, 2 * image : 2 * image + 2]
        T[:, 2, 2] = 1
    sample[:, :, 0] = (A[1].mT @ models @ A[0]).flatten(1).T
    improved = GraphCut(1.0, score)(sample, problem)
    before, after = (score_models(score, F.to(torch.float32), problem) for F in (sample, improved))
    assert bool((after >= before).all())
    assert bool((after[:, 0] > before[:, 0]).all())


def test_models_without_inliers_are_kept() -> None:
    problem = _problem(scene(0, 40))
    nowhere = torch.zeros(9, 1, 1, dtype=torch.float64)
    nowhere[8] = 1  # no point lies on its epipolar line
    assert torch.equal(GraphCut(1.0, TruncatedSquares(1.0))(nowhere, problem), nowhere)


def test_unknown_local_optimization_is_told() -> None:
    with pytest.raises(ValueError, match="local_optimization is 'x'; it must be one of: graph_cut"):
        HypothesizeAndVerify(local_optimization="x")
