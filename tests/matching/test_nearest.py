"""Nearest neighbours, also by 8-bit products, and the matcher of them."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fmtorch.core import Features, collate
from fmtorch.matching import NearestNeighborMatcher, Neighbors, nearest, nearest_neighbors
from fmtorch.matching import nearest as eight_bit
from fmtorch.matching.nearest import GROUP
from tests.conftest import oracle
from tests.reference.local_features import two_nearest

ROWS = st.lists(st.lists(st.integers(0, 2), min_size=2, max_size=2), max_size=40)


def sift_like(seed: int, n: int, d: int = 128, top: int = 60) -> Tensor:
    return torch.randint(0, top, (n, d), generator=torch.Generator().manual_seed(seed)).float()


def unit(seed: int, n: int, d: int = 128) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(n, d, generator=generator), dim=-1)


def assert_same(a: Neighbors, b: Neighbors) -> None:
    for left, right in zip(a, b, strict=True):
        assert torch.equal(left, right)


def assert_is_reference(neighbors: Neighbors, d0: Tensor, d1: Tensor, tolerance: float) -> None:
    index, first, second = two_nearest(d0.numpy(), d1.numpy())
    reverse = two_nearest(d1.numpy(), d0.numpy())[0]
    np.testing.assert_array_equal(neighbors.nearest.numpy(), index)
    np.testing.assert_array_equal(neighbors.reverse.numpy(), reverse)
    np.testing.assert_allclose(neighbors.distance.numpy(), first, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(neighbors.second.numpy(), second, rtol=tolerance, atol=tolerance)


# Distances are rounded once to float32 (2^-24); real-valued unit vectors lie on a grid of 2^-25, which moves a
# distance by at most sqrt(128) 2^-25 = 3.4e-7.
@pytest.mark.parametrize(("n0", "n1"), [(1, 1), (1, 2), (5, 1), (70, 33), (130, 257), (64, 64)])
def test_equals_the_definition_on_whole_numbers(n0: int, n1: int) -> None:
    d0, d1 = sift_like(1, n0), sift_like(2, n1)
    assert_is_reference(nearest_neighbors(d0, d1), d0, d1, 2.0**-23)


@pytest.mark.parametrize("scale", [1.0, 1e-20, 1e15])
def test_equals_the_definition_on_real_numbers(scale: float) -> None:
    d0, d1 = scale * unit(3, 90), scale * unit(4, 75)
    index, first, second = two_nearest(d0.numpy(), d1.numpy())
    neighbors = nearest_neighbors(d0, d1)
    np.testing.assert_array_equal(neighbors.nearest.numpy(), index)
    np.testing.assert_allclose(neighbors.distance.numpy() / scale, first / scale, atol=5e-7)
    np.testing.assert_allclose(neighbors.second.numpy() / scale, second / scale, atol=5e-7)


@settings(max_examples=60, deadline=None)
@given(ROWS, ROWS, st.integers(1, 9))
def test_ties_go_to_the_lowest_index(rows: list[list[int]], columns: list[list[int]], chunk: int) -> None:
    d0, d1 = torch.tensor(rows).reshape(-1, 2).float(), torch.tensor(columns).reshape(-1, 2).float()
    assert_is_reference(nearest_neighbors(d0, d1, chunk=chunk), d0, d1, 2.0**-23)


@pytest.mark.parametrize("make", [sift_like, unit])
def test_chunk_batch_and_padding_are_invisible(make: object) -> None:
    sizes = [(70, 40), (3, 90), (0, 5), (5, 0), (64, 1)]
    pairs = [(make(2 * i, n0), make(2 * i + 1, n1)) for i, (n0, n1) in enumerate(sizes)]  # type: ignore[operator]
    alone = [nearest_neighbors(d0, d1) for d0, d1 in pairs]
    for (d0, d1), expected in zip(pairs, alone, strict=True):
        for chunk in (1, 7, 1000):
            assert_same(nearest_neighbors(d0, d1, chunk=chunk), expected)
    with pytest.raises(ValueError, match="chunk"):
        nearest_neighbors(*pairs[0], chunk=0)

    garbage = [math.nan, math.inf, 1e30]
    batch0, batch1 = torch.empty(len(pairs), 100, 128), torch.empty(len(pairs), 100, 128)
    mask0, mask1 = torch.zeros(len(pairs), 100, dtype=torch.bool), torch.zeros(len(pairs), 100, dtype=torch.bool)
    for b, (d0, d1) in enumerate(pairs):
        batch0[b], batch1[b] = garbage[b % 3], garbage[(b + 1) % 3]
        batch0[b, 4 : 4 + len(d0)], mask0[b, 4 : 4 + len(d0)] = d0, True
        batch1[b, : len(d1)], mask1[b, : len(d1)] = d1, True
    together = nearest_neighbors(batch0, batch1, mask0, mask1)
    for b, (expected, (d0, d1)) in enumerate(zip(alone, pairs, strict=True)):
        assert torch.equal(together.nearest[b, 4 : 4 + len(d0)], expected.nearest)
        assert torch.equal(together.distance[b, 4 : 4 + len(d0)], expected.distance)
        assert torch.equal(together.second[b, 4 : 4 + len(d0)], expected.second)
        shifted = torch.where(expected.reverse >= 0, expected.reverse + 4, -1)
        assert torch.equal(together.reverse[b, : len(d1)], shifted)
        assert (together.nearest[b][~mask0[b]] == -1).all()
        assert (together.reverse[b][~mask1[b]] == -1).all()


def test_leading_dimensions() -> None:
    d0, d1 = sift_like(1, 6 * 10).reshape(2, 3, 10, 128), sift_like(2, 6 * 11).reshape(2, 3, 11, 128)
    neighbors = nearest_neighbors(d0, d1)
    assert (neighbors.nearest.shape, neighbors.reverse.shape) == ((2, 3, 10), (2, 3, 11))
    assert torch.equal(neighbors.nearest[1, 2], nearest_neighbors(d0[1, 2], d1[1, 2]).nearest)
    assert nearest_neighbors(d0[:0], d1[:0]).nearest.shape == (0, 3, 10)


def test_a_descriptor_that_is_not_finite_has_no_neighbour_and_is_none() -> None:
    d0, d1 = sift_like(1, 5), sift_like(2, 5)
    d0[2, 7], d1[int(nearest_neighbors(d0, d1).nearest[0])] = math.nan, math.inf
    neighbors = nearest_neighbors(d0, d1)
    assert neighbors.nearest[2] == -1
    assert torch.isfinite(neighbors.distance[[0, 1, 3, 4]]).all()
    assert not (neighbors.reverse == 2).any()


def test_ratio_says_nothing_where_there_is_nothing_to_compare() -> None:
    d0 = torch.tensor([[0.0, 0.0], [3.0, 4.0]])
    assert nearest_neighbors(d0, d0[:1]).ratio.tolist() == [1.0, 1.0]  # a single candidate
    assert nearest_neighbors(d0, d0[[0, 0]]).ratio.tolist() == [1.0, 1.0]  # two identical candidates
    assert nearest_neighbors(d0, d0[:0]).ratio.tolist() == [1.0, 1.0]  # none
    assert nearest_neighbors(d0, d0).ratio.tolist() == [0.0, 0.0]
    assert nearest_neighbors(d0, torch.tensor([[6.0, 8.0], [0.0, 2.0]])).ratio[0] == pytest.approx(0.2)


def test_equals_opencv_on_real_descriptors() -> None:
    file = oracle("sift.npz")
    d0, d1 = file["000.default.desc"].astype(np.float32), file["001.default.desc"].astype(np.float32)
    expected = cv2.BFMatcher(cv2.NORM_L2).knnMatch(d0, d1, 2)
    neighbors = nearest_neighbors(torch.from_numpy(d0), torch.from_numpy(d1))
    assert neighbors.nearest.tolist() == [m[0].trainIdx for m in expected]
    np.testing.assert_array_equal(neighbors.distance, np.float32([m[0].distance for m in expected]))
    np.testing.assert_array_equal(neighbors.second, np.float32([m[1].distance for m in expected]))
    crossed = {(m.queryIdx, m.trainIdx) for m in cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(d0, d1)}
    assert crossed == {(i, int(neighbors.nearest[i])) for i in neighbors.mutual.nonzero()[:, 0].tolist()}


def skewed(seed: int, n: int, d: int = 128) -> Tensor:
    """Square roots of sparse histograms, in clusters: near neighbours that 8 bits hardly tell apart."""
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(20, d, generator=torch.Generator().manual_seed(0)).pow(4)
    values = centers[torch.randint(0, 20, (n,), generator=generator)] + 0.01 * torch.rand(n, d, generator=generator)
    return torch.nn.functional.normalize(values, p=1, dim=-1).sqrt()


def one_giant(seed: int, n: int) -> Tensor:
    """Unit vectors beside one a hundred times as long, next to which they are rounded to zero."""
    values = unit(seed, n)
    values[n // 2] *= 100
    return values


def without_rounding(monkeypatch: pytest.MonkeyPatch, d0: Tensor, d1: Tensor) -> nearest.Neighbors:
    with monkeypatch.context() as patch:
        patch.setattr(nearest, "two_nearest", lambda *_: None)
        return nearest_neighbors(d0, d1)


@pytest.mark.parametrize("int8", [True, False])
@pytest.mark.parametrize("make", [sift_like, unit, skewed])
@pytest.mark.parametrize(("n0", "n1"), [(1, 1), (3, 2), (700, 1), (130, GROUP), (257, 300), (1000, 900)])
def test_the_same_bits_as_computing_all_distances(make, n0, n1, int8, monkeypatch):
    if int8 and not eight_bit.int8_products_are_exact():
        pytest.skip("this processor multiplies 8-bit integers inexactly")
    monkeypatch.setattr(eight_bit, "int8_products_are_exact", lambda: int8)
    d0, d1 = make(1, n0), make(2, n1)  # type: ignore[operator]
    rows, columns, _ = nearest._integers(d0, d1)
    assert eight_bit.two_nearest(rows, columns) is not None
    assert_same(nearest_neighbors(d0, d1), without_rounding(monkeypatch, d0, d1))


@pytest.mark.parametrize("value", [0.0, 1.0, 0.1])
def test_equal_descriptors_go_to_the_lowest_index(value: float) -> None:
    for field in nearest_neighbors(torch.full((500, 128), value), torch.full((400, 128), value)):
        assert (field == 0).all()


def test_what_rounding_does_not_tell_apart_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    d0, d1 = one_giant(1, 1500), one_giant(2, 1400)
    rows, columns, _ = nearest._integers(d0, d1)
    assert eight_bit.two_nearest(rows, columns) is None
    assert_same(nearest_neighbors(d0, d1), without_rounding(monkeypatch, d0, d1))


def test_blocks_change_nothing() -> None:
    rows, columns, _ = nearest._integers(skewed(1, 300), skewed(2, 310))
    expected = eight_bit.two_nearest(rows, columns)
    for block in (1, 7, 1000):
        neighbors = eight_bit.two_nearest(rows, columns, block)
        for a, b in zip(neighbors[:5], expected[:5], strict=True):
            assert (a == b).all()


def test_long_descriptors_are_left_to_floating_point() -> None:
    d = unit(1, 20, 2000)
    rows, columns, _ = nearest._integers(d, d)
    assert eight_bit.two_nearest(rows, columns) is None
    assert nearest_neighbors(d, d).nearest.tolist() == list(range(20))


@pytest.mark.parametrize("scale", [1e-200, 1e100, 1e200, 1e300])
def test_values_whose_squares_overflow_harm_nothing(scale: float, monkeypatch: pytest.MonkeyPatch) -> None:
    d0, d1 = scale * unit(1, 90).double(), scale * unit(2, 80).double()
    assert torch.equal(nearest_neighbors(d0, d1).nearest, without_rounding(monkeypatch, d0, d1).nearest)


def features(seed: int, n: int) -> Features:
    generator = torch.Generator().manual_seed(seed)
    lafs, scores = 100 * torch.rand(n, 2, 3, generator=generator), torch.rand(n, generator=generator)
    descriptors = torch.randint(0, 60, (n, 32), generator=generator).float()
    return Features(lafs, scores, descriptors, torch.tensor([100 + seed, 200]))


def test_slots_are_the_features_of_image_0() -> None:
    f0, f1 = features(1, 9), features(2, 7)
    neighbors = nearest_neighbors(f0.descriptors, f1.descriptors)
    matches = NearestNeighborMatcher()(f0, f1)
    assert torch.equal(matches.x0[0], f0.keypoints)
    assert torch.equal(matches.x1[0], f1.keypoints[neighbors.nearest])
    assert torch.equal(matches.lafs1[0], f1.lafs[neighbors.nearest])
    assert torch.equal(matches.ratio[0], neighbors.ratio)
    assert matches.mask.all()
    assert (matches.size0.tolist(), matches.size1.tolist()) == ([[101, 200]], [[102, 200]])


def test_mutual_masks_one_sided_matches() -> None:
    f0, f1 = features(1, 30), features(2, 20)
    neighbors = nearest_neighbors(f0.descriptors, f1.descriptors)
    assert torch.equal(NearestNeighborMatcher(mutual=True)(f0, f1).mask[0], neighbors.mutual)


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        NearestNeighborMatcher()(collate([features(1, 3)]), features(2, 3))
