from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fmtorch.compiling.arrays import F8x1
from fmtorch.compiling.kernel import kernel
from fmtorch.geometry import cubic_kernels
from fmtorch.geometry.cubic import cube_root, cubic_roots


def roots_of(*coefficients):
    z, valid = cubic_roots(torch.tensor(coefficients, dtype=torch.float64))
    return sorted(z[valid].tolist())


@pytest.mark.parametrize(
    ("coefficients", "expected"),
    [
        ((1, -6, 11, -6), [1, 2, 3]),
        ((1, 0, 0, -8), [2]),
        ((1, 0, 1, 0), [0]),
        ((1, -3, 3, -1), [1, 1, 1]),
        ((1, 0, 0, 0), [0, 0, 0]),
        ((2, 0, 0, 0), [0, 0, 0]),
        ((0, 1, -3, 2), [1, 2]),
        ((0, 1, 0, 1), []),
        ((0, 1, 0, 0), [0, 0]),
        ((0, 0, 2, -3), [1.5]),
        ((0, 0, 1, 0), [0]),
        ((0, 0, 0, 1), []),
        ((0, 0, 0, 0), []),
        ((1e-12, 1, -3, 2), [-1e12 - 3, 1 + 1e-12, 2 - 8e-12]),
        ((1, -1e8, -1e8, 1), [-1, 1e-8 - 1e-16, 1e8 + 1 - 1e-8]),
        ((1e-9, 1e-9, -1, -1), [-31622.7766016838, -1, 31622.7766016838]),
        ((float("nan"), 1, 1, 1), []),
        ((float("inf"), 1, 1, 1), []),
    ],
)
def test_known_roots(coefficients, expected):
    # To the digits of the expectations; a triple root with representable coefficients is exact.
    np.testing.assert_allclose(roots_of(*coefficients), expected, rtol=1e-12, atol=1e-13)


def test_random_cubics_against_numpy():
    rng = np.random.default_rng(0)
    c = rng.normal(size=(4, 3000)) * 10.0 ** rng.uniform(-3, 3, size=(4, 3000))
    z, valid = cubic_roots(torch.from_numpy(c))
    for i in range(3000):
        expected = np.roots(c[:, i])
        real = np.sort(expected[np.abs(expected.imag) < 1e-7 * np.abs(expected)].real)
        ours = np.sort(z[:, i][valid[:, i]].numpy())
        if len(ours) != len(real):  # a double root within rounding: the discriminant's sign is a matter of luck
            gap = np.abs(expected[:, None] - expected[None])[np.triu_indices(3, 1)].min()
            assert gap < 1e-6 * np.abs(expected).max()
            continue
        # The computed polynomial at the nearest float to a root is rounding error: 8 operations, each within eps of the
        # sum of the terms' magnitudes; rounding the root itself adds three eps more.
        size = np.polyval(np.abs(c[:, i]), np.abs(ours))
        assert (np.abs(np.polyval(c[:, i], ours)) <= 11 * np.finfo(float).eps * size).all()
        np.testing.assert_allclose(ours, real, atol=1e-7 * np.abs(expected).max())  # np.roots: normwise only


@settings(max_examples=300, deadline=None)
@example([1.0, 2149678235974625.0, 1.770644304821928e26, 0.0])  # -2e15, -8e10, 0
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=4, max_size=4))
def test_never_nan_and_every_root_is_one(coefficients):
    c = torch.tensor(coefficients, dtype=torch.float64)
    z, valid = cubic_roots(c)
    assert z.isfinite().all()
    assert not z[~valid].any()
    c = c / c.abs().max()
    for root in z[valid]:
        powers = torch.stack([root**3, root**2, root, torch.ones_like(root)])
        # a double root is known to sqrt(eps), where the polynomial is still of the order of eps
        # (or, for roots near 0: the polynomial with coefficients changed by far less than eps of the largest)
        assert (c * powers).sum().abs() <= ((1e-9 * c.abs() + 1e-20) * powers.abs()).sum()


def test_bits_do_not_depend_on_the_neighbours():
    c = torch.randn(4, 501, dtype=torch.float64)
    z, valid = cubic_roots(c)
    for start, count in ((0, 1), (1, 3), (7, 18), (2, 400)):
        part = cubic_roots(c[:, start : start + count].contiguous())
        assert torch.equal(part[0], z[:, start : start + count])
        assert torch.equal(part[1], valid[:, start : start + count])


def test_gradient():
    c = torch.tensor([[1.0, -6, 11, -5.9], [1, 0.2, 1, -3]], dtype=torch.float64).T.contiguous().requires_grad_()
    assert torch.autograd.gradcheck(lambda c: cubic_roots(c)[0], (c,))
    triple = torch.tensor([1.0, -3, 3, -1], dtype=torch.float64, requires_grad=True)
    cubic_roots(triple)[0].sum().backward()
    assert triple.grad is not None
    assert triple.grad.isfinite().all()


def test_cube_root():
    x = 10.0 ** torch.linspace(-300, 300, 5001, dtype=torch.float64)
    torch.testing.assert_close(cube_root(x) ** 3, x, rtol=8 * torch.finfo(torch.float64).eps, atol=0)


@kernel
def cube_roots(x: F8x1, out: F8x1) -> None:
    for i in range(len(x)):
        out[i] = cubic_kernels._cube_root(x[i])


def test_cube_roots_in_kernels_are_the_same():
    x = torch.logspace(-300, 300, 10007, dtype=torch.float64)
    out = np.empty(len(x))
    cube_roots(x.numpy(), out)
    np.testing.assert_array_equal(out, cube_root(x).numpy())
    assert [cubic_kernels._cube_root(number) for number in x[::100].tolist()] == cube_root(x[::100]).tolist()
