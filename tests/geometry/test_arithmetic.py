from __future__ import annotations

import decimal

import numpy as np
import pytest
import torch

from fmtorch.estimators.models import focal_prior
from fmtorch.geometry import arithmetic
from fmtorch.geometry.arithmetic import (
    SMALL,
    as_components,
    as_matrices,
    as_rows,
    cofactors,
    component_sum,
    cross,
    determinant,
    logarithm,
    logarithm_1p,
    matmul3,
    outer_sum,
    product,
    stable_sum,
    unit,
)
from fmtorch.geometry.significance import LOG_MODELS


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


@pytest.mark.parametrize("n", [3, 7, 9])
@pytest.mark.parametrize("dim", [0, 1])
def test_component_sum_has_the_same_bits_in_small_and_in_large_tensors(n, dim):
    x = torch.randn(n, n, 2000, generator=torch.Generator().manual_seed(n), dtype=torch.float64)
    x[..., :50] = -0.0  # of which a sum is 0, not -0, on both ways
    summed = component_sum(x, dim)
    assert x[..., 30:130].numel() <= SMALL < x.numel()
    assert torch.equal(component_sum(x[..., 30:130], dim).view(torch.int64), summed[..., 30:130].view(torch.int64))
    turned = x[..., 30:130].transpose(0, 2).contiguous().transpose(0, 2)
    assert torch.equal(component_sum(turned, dim).view(torch.int64), summed[..., 30:130].view(torch.int64))
    attached = x[..., 30:130].clone().requires_grad_()
    assert torch.equal(component_sum(attached, dim).view(torch.int64), summed[..., 30:130].view(torch.int64))


def test_matmul3_broadcasts():
    a, b = torch.randn(4, 1, 3, 3, dtype=torch.float64), torch.randn(5, 3, 3, dtype=torch.float64)
    torch.testing.assert_close(matmul3(a, b), a @ b)


def test_outer_sum():
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randint(-9, 9, (5, n, 20), generator=generator).double() for n in (3, 4))
    expected = torch.einsum("kis,kjs->ijs", a, b)
    assert torch.equal(outer_sum(a[:, :, None], b[:, None]), expected)  # integers: exact


def test_exponential_and_logarithm() -> None:
    x = np.linspace(-3, 3, 601)
    # Eight squarings multiply the rounding error of one by 256.
    assert np.abs(arithmetic.exponential(x) / np.exp(x) - 1).max() < 512 * 2**-52
    y = np.concatenate([np.logspace(-300, 300, 1001), np.linspace(0.4, 2.1, 1001)])
    expected = logarithm(torch.from_numpy(y)).tolist()
    assert [arithmetic.logarithm_kernel(number) for number in y.tolist()] == expected


def test_the_logarithm_is_alike_everywhere_and_far_from_one() -> None:
    x = torch.cat([torch.logspace(-300, 300, 1001, dtype=torch.float64), torch.linspace(0.4, 2.1, 1001).double()])
    torch.testing.assert_close(logarithm(x), torch.from_numpy(np.log(x.numpy())), rtol=4 * 2**-52, atol=4 * 2**-52)
    for start in range(1, 20):
        assert torch.equal(logarithm(x[start:]), logarithm(x)[start:])


def test_small_matrices_as_by_numpy() -> None:
    generator = torch.Generator().manual_seed(0)
    A, B = torch.randn(2, 4, 5, 3, 3, generator=generator, dtype=torch.float64).unbind(0)
    a, b = (as_rows(as_components(M)) for M in (A, B))
    # Some additions of products of numbers of about 1: a few eps of absolute error.
    tight = {"rtol": 0, "atol": 1e-13}
    torch.testing.assert_close(as_matrices(product(a, b).flatten(0, 1)), A @ B, **tight)
    torch.testing.assert_close(determinant(a), torch.linalg.det(A), **tight)
    expected = torch.linalg.det(A)[..., None, None] * torch.linalg.inv(A).mT
    torch.testing.assert_close(as_matrices(cofactors(a).flatten(0, 1)), expected, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(cross(a[0], b[0]).movedim(0, -1), torch.cross(A[..., 0, :], B[..., 0, :], -1), **tight)
    torch.testing.assert_close(unit(a.flatten(0, 1)).square().sum(0), torch.ones(4, 5, dtype=torch.float64), **tight)


def test_the_logarithm_of_one_more_is_exact_near_zero_and_the_same_in_kernels() -> None:
    small = torch.logspace(-300, 0, 1001, dtype=torch.float64)
    x = torch.cat(
        [small, -small * 0.999, torch.logspace(0, 300, 301).double(), torch.linspace(-0.3, 0.5, 999).double()]
    )
    expected = np.log1p(x.numpy())
    # Some ten roundings of parts of the value, and of 1 + x where that is small against x or 1.
    np.testing.assert_allclose(logarithm_1p(x).numpy(), expected, rtol=8 * 2**-52, atol=0)
    assert logarithm_1p(x).tolist() == [arithmetic.logarithm_1p_kernel(number) for number in x.tolist()]
    ends = torch.tensor([0.0, torch.inf, torch.nan], dtype=torch.float64)
    assert logarithm_1p(ends)[:2].tolist() == [0, torch.inf]
    assert torch.isnan(logarithm_1p(ends)[2])
    assert [arithmetic.logarithm_1p_kernel(number) for number in (0.0, np.inf)] == [0, np.inf]


def test_constants_are_the_nearest_numbers() -> None:
    with decimal.localcontext(prec=40):
        assert float(decimal.Decimal(2).ln()) == arithmetic.LOG2
        assert float(decimal.Decimal(10).ln()) == arithmetic.LOG10
        assert float(decimal.Decimal(3).ln()) == LOG_MODELS
        assert float(decimal.Decimal(focal_prior.USUAL_FOCAL).ln()) == focal_prior.LOG_USUAL
