"""Ratio, mutual, one-to-one."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor

from fmtorch.core import Correspondences, Features
from fmtorch.matching import NearestNeighborMatcher, nearest_neighbors
from fmtorch.pruning import MutualCheck, OneToOne, RatioTest, mutual, one_to_one, ratio_test
from tests.reference import local_features as matching_reference
from tests.reference.local_features import one_to_one as one_to_one_reference


def test_ratio_is_strict_and_refuses_nan() -> None:
    ratio = torch.tensor([[0.0, 0.79, 0.8, 1.0, math.nan]])
    assert ratio_test(ratio, 0.8).tolist() == [[True, True, False, False, False]]
    assert ratio_test(ratio, 0.8, torch.tensor([[False, True, True, True, True]])).sum() == 1


def test_mutual_agrees_with_the_matcher() -> None:
    generator = torch.Generator().manual_seed(0)
    d0, d1 = torch.rand(2, 40, 8, generator=generator), torch.rand(2, 30, 8, generator=generator)
    mask0, mask1 = torch.rand(2, 40, generator=generator) < 0.8, torch.rand(2, 30, generator=generator) < 0.8
    neighbors = nearest_neighbors(d0, d1, mask0, mask1)
    assert torch.equal(mutual(neighbors.nearest, neighbors.reverse), neighbors.mutual)
    garbage = torch.where(mask0, neighbors.nearest, 10**9)
    assert torch.equal(mutual(garbage, neighbors.reverse, mask0), neighbors.mutual)
    assert not mutual(neighbors.nearest, neighbors.reverse[:, :0]).any()


@pytest.mark.parametrize("seed", range(4))
def test_ratio_and_mutual_stages_equal_their_definitions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    d0, d1 = rng.random((30, 8), np.float32), rng.random((24 + seed, 8), np.float32)
    d1[:10] = d0[:10] + rng.normal(0, 0.05, (10, 8))

    def features(descriptors: np.ndarray) -> Features:
        n = len(descriptors)
        lafs = torch.zeros(n, 2, 3)
        lafs[:, :, 2] = torch.from_numpy(rng.random((n, 2)))
        return Features(lafs, torch.ones(n), torch.from_numpy(descriptors), torch.tensor([9, 9]))

    matches = NearestNeighborMatcher()(features(d0), features(d1))
    ratio, both = RatioTest(0.8)(matches).mask[0], MutualCheck()(matches).mask[0]
    np.testing.assert_array_equal(ratio, matching_reference.ratio_test(d0, d1, 0.8))
    np.testing.assert_array_equal(both, matching_reference.mutual(d0, d1))
    assert 0 < int(ratio.sum()) < 30
    assert 0 < int(both.sum()) < 30
    order = matches.compact()
    assert torch.equal(MutualCheck()(order).count(), both.sum()[None])
    with pytest.raises(ValueError, match="needs `mutual`"):
        MutualCheck()(matches.replace(mutual=None))


def grid_points(n: int) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float32, (n, 2), elements=st.sampled_from([0.0, -0.0, 0.1, 1.5]))


@settings(max_examples=80, deadline=None)
@given(st.data(), st.integers(0, 12))
def test_one_to_one_equals_the_definition(data: st.DataObject, n: int) -> None:
    x0, x1 = data.draw(grid_points(n)), data.draw(grid_points(n))
    ratio = data.draw(arrays(np.float32, (n,), elements=st.sampled_from([0.25, 0.5, math.inf])))
    mask = one_to_one(*(torch.from_numpy(a)[None] for a in (x0, x1, ratio)))
    np.testing.assert_array_equal(mask[0], one_to_one_reference(x0, x1, ratio))


def duplicated(seed: int, n: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor, Tensor]:
    """Points drawn from few locations, so that most locations repeat; no two ratios are equal."""
    generator = torch.Generator().manual_seed(seed)
    places = 100 * torch.rand(2, max(n // 3, 1), 2, generator=generator, dtype=dtype)
    pick = torch.randint(0, places.shape[1], (2, n), generator=generator)
    ratio = torch.randperm(n, generator=generator).to(dtype) / max(n, 1)
    return places[0, pick[0]], places[1, pick[1]], ratio


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_to_one_is_symmetric_and_independent_of_order(dtype: torch.dtype) -> None:
    x0, x1, ratio = (a[None] for a in duplicated(0, 200, dtype))
    kept = one_to_one(x0, x1, ratio)
    assert 0 < kept.sum() < 200
    assert torch.equal(kept, one_to_one(x1, x0, ratio))
    order = torch.randperm(200, generator=torch.Generator().manual_seed(1))
    assert torch.equal(kept[:, order], one_to_one(x0[:, order], x1[:, order], ratio[:, order]))
    for x in (x0, x1):
        assert len(torch.unique(x[kept], dim=0)) == kept.sum()


def test_one_to_one_drops_what_has_no_location_and_ranks_nan_ratio_last() -> None:
    x0 = torch.tensor([[[math.nan, 0.0], [math.inf, 0.0], [1.0, 1.0], [1.0, 1.0]]])
    x1 = torch.arange(8.0).reshape(1, 4, 2)
    ratio = torch.tensor([[0.0, 0.0, math.nan, 0.9]])
    assert one_to_one(x0, x1, ratio).tolist() == [[False, False, False, True]]


def test_stages_need_a_ratio_and_keep_the_rest() -> None:
    x0, x1, ratio = (a[None] for a in duplicated(0, 20))
    mask = torch.ones(1, 20, dtype=torch.bool)
    for stage, expected in ((RatioTest(0.5), ratio_test(ratio, 0.5)), (OneToOne(), one_to_one(x0, x1, ratio))):
        out = stage(Correspondences(x0, x1, mask, ratio))
        assert torch.equal(out.mask, expected)
        assert torch.equal(out.x0, x0)
        with pytest.raises(ValueError, match="ratio"):
            stage(Correspondences(x0, x1, mask))
