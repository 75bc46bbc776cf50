import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fmtorch.core import Correspondences
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


def test_stage_and_bad_input() -> None:
    x0, x1 = (x[None].float() for x in moving(3, 200))
    x0[0, 7, 0] = torch.nan
    mask = torch.arange(200)[None] % 3 != 0
    kept = LPM(neighbors=[5, 6])(Correspondences(x0, x1, mask)).mask
    assert torch.equal(kept, lpm(x0, x1, mask=mask, neighbors=(5, 6)))
    assert not kept[0, 7]
    with pytest.raises(ValueError, match="at least 4"):
        lpm(x0, x1, neighbors=(3, 6))
