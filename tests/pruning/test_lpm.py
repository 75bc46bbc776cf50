from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.jit.kernel import F8x2, I8x2, kernel
from fmtorch.pruning import LPM, lpm
from fmtorch.pruning import neighbors as knn_kernels
from tests.conftest import oracle
from tests.reference.lpm import lpm as reference
from tests.reference.lpm import nearest


@kernel
def search(queries: F8x2, points: F8x2, neighbors: I8x2) -> None:
    knn_kernels.search(queries, points, neighbors)


def nearest_points(queries: np.ndarray, points: np.ndarray, count: int) -> np.ndarray:
    neighbors = np.empty((len(queries), count), np.int64)
    search(queries, points, neighbors)
    return neighbors


def moving(seed: int, n: int, outliers: float = 0.4) -> tuple[Tensor, Tensor]:
    """Matches that follow a smooth motion; some wrong, some repeated, some that do not move."""
    rng = np.random.default_rng(seed)
    x0 = rng.uniform(0, 500, (n, 2))
    x1 = x0 @ np.array([[0.95, 0.2], [-0.2, 0.95]]) + (30, 10) + rng.normal(0, 0.5, (n, 2))
    wrong = rng.random(n) < outliers
    x1[wrong] = rng.uniform(0, 500, (int(wrong.sum()), 2))
    if n > 20:
        x0[5:10], x1[8:12] = x0[0], x1[1]
        x1[15:18] = x0[15:18]
    return torch.from_numpy(x0), torch.from_numpy(x1)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 60), st.integers(0, 60), st.integers(1, 12), st.booleans())
def test_nearest_points_equal_the_definition(seed: int, n: int, m: int, count: int, coarse: bool) -> None:
    rng = np.random.default_rng(seed)
    queries, points = rng.uniform(0, 6, (n, 2)), rng.uniform(0, 6, (m, 2))
    if coarse:  # ties everywhere
        queries, points = queries.round(), points.round()
    neighbors = nearest_points(queries, points, count)
    for query, row in zip(queries, neighbors.tolist(), strict=True):
        expected = nearest(query, points, list(range(m)), count)
        assert row == expected + [-1] * (count - len(expected))


@pytest.mark.parametrize("kind", ["uniform", "clusters", "line", "grid", "one place"])
def test_nearest_points_of_many(kind: str) -> None:
    rng = np.random.default_rng(1)
    n = 1500
    points = {
        "uniform": rng.uniform(0, 1000, (n, 2)),
        "clusters": rng.normal(0, 1, (n, 2)) + 500 * rng.integers(0, 3, (n, 2)),
        "line": np.stack([np.full(n, 3.0), rng.uniform(0, 1000, n)], 1),
        "grid": np.stack(np.meshgrid(np.arange(50), np.arange(30)), -1).reshape(-1, 2)[rng.permutation(n)] * 1.0,
        "one place": np.full((n, 2), 7.0),
    }[kind]
    queries = np.concatenate([points[:400], rng.uniform(-200, 1200, (100, 2))])
    neighbors = nearest_points(queries, points, 9)
    expected = cKDTree(points).query(queries, 9)[0]
    distances = np.linalg.norm(points[neighbors] - queries[:, None], axis=-1)
    np.testing.assert_allclose(distances, expected, rtol=1e-14, atol=1e-14)  # a few roundings of float64
    squared = ((points[neighbors] - queries[:, None]) ** 2).sum(-1)
    assert ((np.diff(squared) > 0) | (np.diff(neighbors) > 0)).all()  # ties by index
    if kind == "one place":
        assert (neighbors[:400] == np.arange(9)).all()


def test_masks_equal_the_original() -> None:
    file = oracle("lpm.npz")
    for i, name in enumerate(file["names"]):
        case = {k[4:]: v for k, v in file.items() if k.startswith(f"{i:03d}.")}
        lambda1, lambda2, K1, K2, tau1, tau2 = case["params"].tolist()
        x0, x1 = torch.from_numpy(case["X"]), torch.from_numpy(case["Y"])
        mask = lpm(x0[None], x1[None], thresholds=(lambda1, lambda2), neighbors=(int(K1), int(K2)), taus=(tau1, tau2))
        np.testing.assert_array_equal(mask[0], case["mask"], str(name))
        for x, key in ((case["X"], "nX1"), (case["Y"], "nY1")):
            np.testing.assert_array_equal(nearest_points(x, x, int(K1) + 3), case[key], str(name))


@pytest.mark.parametrize("n", [0, 1, 2, 9, 13, 40, 160])
@pytest.mark.parametrize("neighbors", [(6, 6), (4, 7)])
def test_equals_the_definition(n: int, neighbors: tuple[int, int]) -> None:
    x0, x1 = moving(n, n)
    mask = lpm(x0[None], x1[None], neighbors=neighbors, thresholds=(0.8, 0.6), taus=(0.2, 0.4))
    expected = reference(x0.numpy(), x1.numpy(), (0.8, 0.6), neighbors, (0.2, 0.4))
    np.testing.assert_array_equal(mask[0], expected)


def test_neighbourhoods_may_be_large() -> None:
    x0, x1 = moving(3, 300)
    expected = reference(x0.numpy(), x1.numpy(), (0.8, 0.8), (260, 6), (0.2, 0.2))
    mask = lpm(x0[None], x1[None], neighbors=(260, 6), thresholds=(0.8, 0.8))
    assert 0 < expected.sum() < 300
    np.testing.assert_array_equal(mask[0], expected)


def test_keeps_a_common_motion_and_drops_scattered_matches() -> None:
    x0, x1 = moving(0, 1000, outliers=0.5)
    turn = torch.tensor([[0.95, 0.2], [-0.2, 0.95]], dtype=torch.float64)
    right = (x1 - x0 @ turn - torch.tensor([30.0, 10.0])).norm(dim=1) < 3
    kept = lpm(x0[None], x1[None])[0]
    assert (kept & right).sum() > 0.9 * right.sum()
    assert (kept & ~right).sum() < 0.05 * kept.sum()


def test_padding_and_neighbours_are_invisible() -> None:
    counts = [120, 0, 1, 57, 300]
    pairs = [moving(i, n) for i, n in enumerate(counts)]
    alone = [lpm(a[None], b[None])[0] for a, b in pairs]
    for garbage in (float("nan"), 1e30, 100.0):
        x0, x1 = torch.full((5, 340, 2), garbage).double(), torch.full((5, 340, 2), garbage).double()
        mask = torch.zeros(5, 340, dtype=torch.bool)
        slots = torch.randperm(340, generator=torch.Generator().manual_seed(0))
        for b, (a0, a1) in enumerate(pairs):
            here = slots[: len(a0)].sort().values
            x0[b, here], x1[b, here], mask[b, here] = a0, a1, True
        together = lpm(x0, x1, mask=mask)
        assert not together[~mask].any()
        for b, (a0, _) in enumerate(pairs):
            assert torch.equal(together[b, slots[: len(a0)].sort().values], alone[b])


def test_stage_and_bad_input() -> None:
    x0, x1 = (x[None].float() for x in moving(3, 200))
    x0[0, 7, 0] = torch.nan
    mask = torch.arange(200)[None] % 3 != 0
    kept = LPM(neighbors=[5, 6])(Correspondences(x0, x1, mask)).mask
    assert torch.equal(kept, lpm(x0, x1, mask=mask, neighbors=(5, 6)))
    assert not kept[0, 7]
    with pytest.raises(ValueError, match="at least 4"):
        lpm(x0, x1, neighbors=(3, 6))
