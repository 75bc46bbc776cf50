"""The square root that all tensors of values take: NumPy's, to the bit, with gradients that stay finite."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmtorch.geometry.arithmetic import sqrt
from fmtorch.geometry.epipolar import inverse_root
from fmtorch.jit.kernel import F8x2, kernel
from fmtorch.jit.lanes import LANES, load, store
from fmtorch.jit.lanes import sqrt as sqrt_of_lanes

KINDS = {torch.float32: np.float32, torch.float64: np.float64}


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


@pytest.mark.parametrize("dtype", KINDS)
def test_roots_are_those_of_numpy(dtype: torch.dtype) -> None:
    x = numbers(dtype)
    expected = np.sqrt(x.numpy())
    np.testing.assert_array_equal(sqrt(x).numpy(), expected)
    np.testing.assert_array_equal(sqrt(x.clone().requires_grad_()).detach().numpy(), expected)
    np.testing.assert_array_equal(sqrt(x[3::5]).numpy(), expected[3::5])
    np.testing.assert_array_equal(sqrt(x[:4096].view(64, 64).T).numpy(), expected[:4096].reshape(64, 64).T)
    np.testing.assert_array_equal(sqrt(x[7]).numpy(), expected[7])
    assert sqrt(x[:0]).shape == (0,)
    assert torch.isnan(sqrt(torch.tensor([-1.0, torch.nan], dtype=dtype))).all()


def test_roots_are_rounded_correctly() -> None:
    """The nearest float32 to a root is that of the float64 root: no root of 24 bits lies nearer to a midpoint."""
    x = numbers(torch.float32)
    np.testing.assert_array_equal(sqrt(x).numpy(), np.sqrt(x.numpy().astype(np.float64)).astype(np.float32))


def test_roots_in_kernels_are_the_same() -> None:
    x = numbers(torch.float64)[: 1 << 12]
    out = np.empty((len(x) // LANES, LANES))
    roots_of_lanes(x.numpy().reshape(out.shape), out)
    np.testing.assert_array_equal(sqrt(x).numpy(), out.ravel())


@pytest.mark.parametrize("dtype", KINDS)
def test_inverse_roots_are_those_of_numpy(dtype: torch.dtype) -> None:
    x = numbers(dtype)
    x = x[torch.isfinite(x) & (x >= torch.finfo(dtype).smallest_normal)]
    np.testing.assert_array_equal(inverse_root(x).numpy(), 1 / np.sqrt(x.numpy()))


def test_gradients_of_first_and_second_order() -> None:
    x = torch.tensor([0.25, 1.0, 3.0, 1e6], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(sqrt, x)
    assert torch.autograd.gradgradcheck(sqrt, x)
    zero = torch.tensor([0.0, -0.0, 4.0], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(sqrt(zero).sum(), zero, create_graph=True)
    assert slope.tolist() == [0, 0, 0.25]
    (second,) = torch.autograd.grad(slope.sum(), zero)
    assert second.tolist() == [0, 0, -1 / 32]
