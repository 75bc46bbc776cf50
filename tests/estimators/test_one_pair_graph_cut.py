"""The local optimisation of Graph-Cut RANSAC on the arrays of one pair, against the tensor form."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmtorch.core.types import Correspondences
from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.graph_cut import GraphCut
from fmtorch.estimators.one_pair.graph_cut import GraphCut as GraphCutOfOne
from fmtorch.estimators.one_pair.graph_cut import neighbor_graph as neighbor_graph_of_one
from fmtorch.estimators.one_pair.pair import OnePair
from fmtorch.estimators.one_pair.selection import scored
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.registry import kernel_form
from fmtorch.estimators.scores import TruncatedSquares
from fmtorch.estimators.spatial import gaussian_kernel, neighbor_graph, spatially_coherent_inliers
from fmtorch.geometry.residuals import sampson_squared
from tests.conftest import oracle
from tests.estimators.test_one_pair import both, told
from tests.laws import SMALL_KINDS, small

pytest.importorskip("numba", reason="numba is not installed")

NAMES = ("scene 40", "scene 150", "scene 700", "real 0", "real 7", "real 13")


def given(name: str) -> tuple[NormalizedPairs, OnePair]:
    """A synthetic pair of so many matches, or one of the real ones."""
    kind, i = name.split()[0], int(name.split()[1])
    if kind == "scene":
        return both(told(i))
    file = oracle("robust.npz")
    x0, x1 = (torch.from_numpy(file[f"{i:03d}.{field}"])[None] for field in ("X1", "X2"))
    return both(Correspondences(x0, x1, torch.ones(x0.shape[:2], dtype=torch.bool), key=torch.tensor([i])))


def parts() -> tuple[GraphCut, GraphCutOfOne]:
    score = TruncatedSquares(1.0)
    part = GraphCut(1.0, score)
    return part, kernel_form(part, kernel_form(score))


def searched(pairs: NormalizedPairs) -> torch.Tensor:
    """The best models (9, 1, 4) of a short search, float64."""
    return HypothesizeAndVerify(hypotheses=100, round=50, pool=4).search(pairs).models


@pytest.mark.parametrize("radius", [5.0, 20.0, 200.0])
@pytest.mark.parametrize("name", NAMES)
def test_the_same_neighbours(name: str, radius: float) -> None:
    pairs, pair = given(name)
    expected = neighbor_graph(pairs, radius)
    graph, degree = neighbor_graph_of_one(pair, radius)
    np.testing.assert_array_equal(degree, expected.degree[0, : pair.count])
    edges = {(i, int(j)) for i in range(pair.count) for j in graph[i, : degree[i]]}
    assert edges == set(zip(expected.head.tolist(), expected.tail.tolist(), strict=True))
    assert len(edges) == degree.sum()


@pytest.mark.parametrize("name", NAMES)
def test_labels(name: str) -> None:
    """Kernels of residuals may be rounded to neighbouring multiples of 2^-10, and labels where that decides."""
    pairs, pair = given(name)
    part, compiled = parts()
    graph, of_one = neighbor_graph(pairs, part.RADIUS_PX), neighbor_graph_of_one(pair, part.RADIUS_PX)
    F = searched(pairs)
    scale = (pairs.pixels_per_unit / part.threshold).square()[:, None, None]
    kernel = gaussian_kernel(sampson_squared(F, pairs.points) * scale)
    expected = spatially_coherent_inliers(kernel, pairs.mask, graph, part.COHERENCE)[0, :, : pair.count].numpy()
    found = np.stack([compiled.labels(model, pair, of_one) for model in F[:, 0].T.contiguous().numpy()])
    assert expected.any()
    assert np.count_nonzero(found != expected) <= 1e-3 * expected.size


@pytest.mark.parametrize("name", NAMES)
def test_fits_are_the_same_models_of_the_same_draws(name: str) -> None:
    pairs, pair = given(name)
    part, compiled = parts()
    inliers = sampson_squared(searched(pairs)[..., :1], pairs.points)[0, 0] * pairs.pixels_per_unit**2 <= 4.0
    labels = inliers & pairs.mask[0]
    for iteration in (0, 1):
        F, valid = part._fits(labels[None, None], pairs, iteration)
        expected = F[:, 0, 0, valid[0, 0]].T.numpy()
        found = compiled.fits(labels[: pair.count].numpy(), pair, iteration)
        assert found.shape == expected.shape
        # Samples that hold few different matches are ill conditioned.
        apart = np.abs(found - expected).max(1)
        assert np.median(apart) < 1e-10
        assert apart.max() < 1e-5
    assert len(compiled.fits(np.zeros(pair.count, np.bool_), pair, 0)) == 0


@pytest.mark.parametrize("name", NAMES)
def test_models_are_improved_alike(name: str) -> None:
    pairs, pair = given(name)
    part, compiled = parts()
    F = searched(pairs)
    start = F[:, 0].T.contiguous().numpy()
    expected = part(F, pairs)[:, 0].T.contiguous().numpy()
    found = compiled(start, pair)
    before, after, reference = (scored(compiled.score, models, pair) for models in (start, found, expected))
    assert (after >= before).all()
    assert (after > before).any()
    np.testing.assert_allclose(after, reference, rtol=0.01)


@pytest.mark.parametrize("kind", ["random", *SMALL_KINDS[:3], "half coincident"])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_few_matches_and_any_model(kind: str, scale: float) -> None:
    """Nothing raises; no model becomes worse; those that are finite stay so."""
    _, compiled = parts()
    for count in (8, 20):
        c = small()[f"{count} {kind}"]
        _, pair = both(c.replace(x0=scale * c.x0, x1=scale * c.x1))
        F = np.vstack([np.zeros(9), np.ones(9), np.random.default_rng(0).normal(size=(6, 9))])
        found = compiled(F, pair)
        assert np.isfinite(found).all()
        assert (scored(compiled.score, found, pair) >= scored(compiled.score, F, pair)).all()
