import pytest
import torch
from torch import Tensor

from fmtorch.matching import nearest, nearest_neighbors
from fmtorch.matching import nearest as eight_bit
from fmtorch.matching.nearest import GROUP
from tests.matching.test_nearest import assert_same, sift_like, unit


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
        patch.setattr(nearest, "_compiled", lambda *_: None)
        return nearest_neighbors(d0, d1)


@pytest.mark.parametrize("int8", [True, False])
@pytest.mark.parametrize("make", [sift_like, unit, skewed])
@pytest.mark.parametrize(("n0", "n1"), [(1, 1), (3, 2), (700, 1), (130, GROUP), (257, 300), (1000, 900)])
def test_the_same_bits_as_computing_all_distances(
    make: object, n0: int, n1: int, int8: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if int8 and not eight_bit.int8_products_are_exact():
        pytest.skip("this processor multiplies 8-bit integers inexactly")
    monkeypatch.setattr(eight_bit, "int8_products_are_exact", lambda: int8)
    d0, d1 = make(1, n0), make(2, n1)  # type: ignore[operator]
    rows, columns, _ = nearest._integers(d0, d1)
    assert eight_bit.two_nearest(rows, columns) is not None
    assert_same(nearest_neighbors(d0, d1), without_rounding(monkeypatch, d0, d1))


@pytest.mark.parametrize("value", [0.0, 1.0, 0.1])
def test_equal_descriptors_go_to_the_lowest_index(value: float) -> None:
    neighbors = nearest_neighbors(torch.full((500, 128), value), torch.full((400, 128), value))
    assert (neighbors.nearest == 0).all()
    assert (neighbors.reverse == 0).all()
    assert (neighbors.distance == 0).all()
    assert (neighbors.second == 0).all()


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
