import decimal

import numpy as np
import pytest
import torch

from fmtorch.estimators.models import focal_prior
from fmtorch.geometry import arithmetic
from fmtorch.geometry.arithmetic import as_components, as_matrices, as_rows, component_sum
from fmtorch.geometry.significance import LOG_MODELS
from fmtorch.jit.kernel import F8x2, kernel
from fmtorch.jit.lanes import LANES, load, store
from fmtorch.jit.lanes import sqrt as sqrt_of_lanes


@pytest.mark.parametrize("n", [0, 1, 2, 3, 7, 8, 9, 100, 760, 1000])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_stable_sum_is_a_sum_that_padding_and_neighbours_do_not_change(n, dtype):
    x = torch.randn(5, n, 3, generator=torch.Generator().manual_seed(n), dtype=dtype)
    total = arithmetic.stable_sum(x, 1)
    exact = x.double().sum(1)
    # A tree of depth log2 n <= 10: each partial sum is rounded at most 10 times.
    bound = 10 * torch.finfo(dtype).eps * x.double().abs().sum(1)
    assert ((total.double() - exact).abs() <= bound).all()
    for padding in (1, 5, 64, 3000):
        assert torch.equal(arithmetic.stable_sum(torch.cat([x, x.new_zeros(5, padding, 3)], 1), 1), total)
    for i in range(5):
        assert torch.equal(arithmetic.stable_sum(x[i], 0), total[i])
    assert torch.equal(arithmetic.stable_sum(x.permute(2, 0, 1).contiguous(), -1), total.permute(1, 0))


@pytest.mark.parametrize("n", [3, 7, 9])
@pytest.mark.parametrize("dim", [0, 1])
def test_component_sum_has_the_same_bits_in_small_and_in_large_tensors(n, dim):
    x = torch.randn(n, n, 2000, generator=torch.Generator().manual_seed(n), dtype=torch.float64)
    x[..., :50] = -0.0  # of which a sum is 0, not -0, on both ways
    expected, small = component_sum(x, dim)[..., 30:130].view(torch.int64), x[..., 30:130]
    assert small.numel() <= arithmetic.SMALL < x.numel()
    for same in (small, small.transpose(0, 2).contiguous().transpose(0, 2), small.clone().requires_grad_()):
        assert torch.equal(component_sum(same, dim).view(torch.int64), expected)


def test_exponential_and_logarithm() -> None:
    x = np.linspace(-3, 3, 601)
    # Eight squarings multiply the rounding error of one by 256.
    assert np.abs(arithmetic.exponential(x) / np.exp(x) - 1).max() < 512 * 2**-52
    y = torch.from_numpy(np.concatenate([np.logspace(-300, 300, 1001), np.linspace(0.4, 2.1, 1001)]))
    logarithm = arithmetic.logarithm(y)
    assert [arithmetic.logarithm_kernel(number) for number in y.tolist()] == logarithm.tolist()
    np.testing.assert_allclose(logarithm, np.log(y.numpy()), rtol=4 * 2**-52, atol=4 * 2**-52)
    for start in range(1, 20):  # alike at any place
        assert torch.equal(arithmetic.logarithm(y[start:]), logarithm[start:])


def test_the_logarithm_of_one_more_is_exact_near_zero_and_the_same_in_kernels() -> None:
    small = np.logspace(-300, 0, 1001)
    x = np.concatenate([small, -small * 0.999, np.logspace(0, 300, 301), np.linspace(-0.3, 0.5, 999)])
    # Some ten roundings of parts of the value, and of 1 + x where that is small against x or 1.
    values = [arithmetic.logarithm_1p_kernel(number) for number in x.tolist()]
    np.testing.assert_allclose(values, np.log1p(x), rtol=8 * 2**-52, atol=0)
    assert [arithmetic.logarithm_1p_kernel(number) for number in (0.0, np.inf)] == [0, np.inf]


def test_constants_are_the_nearest_numbers() -> None:
    with decimal.localcontext(prec=40):
        assert float(decimal.Decimal(2).ln()) == arithmetic.LOG2
        assert float(decimal.Decimal(10).ln()) == arithmetic.LOG10
        assert float(decimal.Decimal(3).ln()) == LOG_MODELS
        assert float(decimal.Decimal(focal_prior.USUAL_FOCAL).ln()) == focal_prior.LOG_USUAL


@pytest.mark.parametrize("m", [0, 1, 2, 3, 10, 200])
@pytest.mark.parametrize("different", [3, 10**9])
def test_keys_are_sorted_with_their_values_and_ties_by_these(m: int, different: int) -> None:
    rng = np.random.default_rng(m)
    key, value = rng.integers(0, different, m), rng.permutation(m)
    order = np.lexsort([value, key])
    expected = key[order], value[order]
    for k in range(0, m, 7):
        assert arithmetic.smallest_but(key.copy(), 0, m, k) == expected[0][k]
    arithmetic.sort_by(key, value)
    np.testing.assert_array_equal((key, value), expected)


@kernel
def roots_of_lanes(x: F8x2, out: F8x2) -> None:
    for row in range(len(x)):
        store(out, row, sqrt_of_lanes(load(x, row)))


def numbers(dtype: torch.dtype) -> torch.Tensor:
    """Mantissas of all kinds at all usual exponents, and the ends of the range."""
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(1 << 18, dtype=torch.float64, generator=generator) + 1
    x = torch.ldexp(x, torch.randint(-60, 60, x.shape, generator=generator)).to(dtype)
    limits = torch.finfo(dtype)
    ends = [0.0, -0.0, limits.smallest_normal, limits.smallest_normal / 4, limits.max, torch.inf, 1.0, 4.0]
    return torch.cat([x, torch.tensor(ends, dtype=dtype)])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_roots_are_those_of_numpy(dtype: torch.dtype) -> None:
    x = numbers(dtype)
    expected = np.sqrt(x.numpy())
    np.testing.assert_array_equal(arithmetic.sqrt(x).numpy(), expected)
    np.testing.assert_array_equal(arithmetic.sqrt(x.clone().requires_grad_()).detach().numpy(), expected)
    np.testing.assert_array_equal(arithmetic.sqrt(x[3::5]).numpy(), expected[3::5])
    np.testing.assert_array_equal(arithmetic.sqrt(x[:4096].view(64, 64).T).numpy(), expected[:4096].reshape(64, 64).T)
    np.testing.assert_array_equal(arithmetic.sqrt(x[7]).numpy(), expected[7])
    assert arithmetic.sqrt(x[:0]).shape == (0,)
    assert torch.isnan(arithmetic.sqrt(torch.tensor([-1.0, torch.nan], dtype=dtype))).all()


def test_roots_in_kernels_are_the_same() -> None:
    x = numbers(torch.float64)[: 1 << 12]
    out = np.empty((len(x) // LANES, LANES))
    roots_of_lanes(x.numpy().reshape(out.shape), out)
    np.testing.assert_array_equal(arithmetic.sqrt(x).numpy(), out.ravel())


def test_gradients_of_first_and_second_order() -> None:
    x = torch.tensor([0.25, 1.0, 3.0, 1e6], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(arithmetic.sqrt, x)
    assert torch.autograd.gradgradcheck(arithmetic.sqrt, x)
    zero = torch.tensor([0.0, -0.0, 4.0], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(arithmetic.sqrt(zero).sum(), zero, create_graph=True)
    assert slope.tolist() == [0, 0, 0.25]
    (second,) = torch.autograd.grad(slope.sum(), zero)
    assert second.tolist() == [0, 0, -1 / 32]


@pytest.mark.parametrize("n", range(1, 17))
@pytest.mark.parametrize("dim", [0, 1, -1])
def test_component_sum(n, dim):
    x = torch.arange(n**3, dtype=torch.float64).reshape(n, n, n)
    assert torch.equal(component_sum(x, dim), x.sum(dim))  # integers: exact


def test_small_matrices_as_by_numpy() -> None:
    A, B = torch.randn(2, 4, 5, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).unbind(0)
    a, b = (as_rows(as_components(M)) for M in (A, B))
    # Some additions of products of numbers of about 1: a few eps of absolute error.
    tight = {"rtol": 0, "atol": 1e-13}
    torch.testing.assert_close(as_matrices(arithmetic.product(a, b).flatten(0, 1)), A @ B, **tight)
    torch.testing.assert_close(arithmetic.determinant(a), torch.linalg.det(A), **tight)
    expected = torch.linalg.det(A)[..., None, None] * torch.linalg.inv(A).mT
    torch.testing.assert_close(as_matrices(arithmetic.cofactors(a).flatten(0, 1)), expected, rtol=1e-11, atol=1e-11)
    expected = torch.linalg.cross(A[..., 0, :], B[..., 0, :])
    torch.testing.assert_close(arithmetic.cross(a[0], b[0]).movedim(0, -1), expected, **tight)
    torch.testing.assert_close(arithmetic.unit(a.flatten(0, 1)).square().sum(0), torch.ones(4, 5).double(), **tight)
