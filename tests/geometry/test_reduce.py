from __future__ import annotations

import pytest
import torch

from fmtorch.geometry.reduce import component_sum, matmul3, outer_sum, stable_sum


@pytest.mark.parametrize("n", [0, 1, 2, 3, 7, 8, 9, 100, 760, 1000])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_stable_sum_is_a_sum_that_padding_and_neighbours_do_not_change(n, dtype):
    x = torch.randn(5, n, 3, generator=torch.Generator().manual_seed(n), dtype=dtype)
    total = stable_sum(x, 1)
    exact = x.double().sum(1)
    # A tree of depth log2 n <= 10: each partial sum is rounded at most 10 times.
    bound = 10 * torch.finfo(dtype).eps * x.double().abs().sum(1)
    assert ((total.double() - exact).abs() <= bound).all()
    for padding in (1, 5, 64, 3000):
        assert torch.equal(stable_sum(torch.cat([x, x.new_zeros(5, padding, 3)], 1), 1), total)
    for i in range(5):
        assert torch.equal(stable_sum(x[i], 0), total[i])
    assert torch.equal(stable_sum(x.permute(2, 0, 1).contiguous(), -1), total.permute(1, 0))


@pytest.mark.parametrize("n", range(1, 17))
@pytest.mark.parametrize("dim", [0, 1, -1])
def test_component_sum(n, dim):
    x = torch.arange(n**3, dtype=torch.float64).reshape(n, n, n)
    assert torch.equal(component_sum(x, dim), x.sum(dim))  # integers: exact


def test_matmul3_broadcasts():
    a, b = torch.randn(4, 1, 3, 3, dtype=torch.float64), torch.randn(5, 3, 3, dtype=torch.float64)
    torch.testing.assert_close(matmul3(a, b), a @ b)


def test_outer_sum():
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randint(-9, 9, (5, n, 20), generator=generator).double() for n in (3, 4))
    expected = torch.einsum("kis,kjs->ijs", a, b)
    assert torch.equal(outer_sum(a[:, :, None], b[:, None]), expected)  # integers: exact
