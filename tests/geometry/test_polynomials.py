import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fmtorch.geometry.seven_point import cube_root, cubic_roots
from fmtorch.jit.kernel import F8x1, kernel


def roots_of(*coefficients):
    """The real roots, by the kernel's function interpreted."""
    roots, valid = np.zeros(3), np.zeros(3, np.bool_)
    cubic_roots(np.array(coefficients, dtype=np.float64), roots, valid)
    return sorted(roots[valid].tolist())


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


@settings(max_examples=300, deadline=None)
@example([1.0, 2149678235974625.0, 1.770644304821928e26, 0.0])  # -2e15, -8e10, 0
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=4, max_size=4))
def test_never_nan_and_every_root_is_one(coefficients):
    roots = roots_of(*coefficients)
    assert np.isfinite(roots).all()
    for root in roots:
        c = np.array(coefficients) / np.abs(coefficients).max()
        powers = np.array([root**3, root**2, root, 1.0])
        # a double root is known to sqrt(eps), where the polynomial is still of the order of eps
        # (or, for roots near 0: the polynomial with coefficients changed by far less than eps of the largest)
        assert abs((c * powers).sum()) <= ((1e-9 * np.abs(c) + 1e-20) * np.abs(powers)).sum()


@kernel
def cube_roots(x: F8x1, out: F8x1) -> None:
    for i in range(len(x)):
        out[i] = cube_root(x[i])


def test_cube_roots():
    x = 10.0 ** np.linspace(-300, 300, 10007)
    out = np.empty(len(x))
    cube_roots(x, out)
    np.testing.assert_allclose(out * out * out, x, rtol=8 * np.finfo(float).eps)
    assert [cube_root(number) for number in x[::100].tolist()] == out[::100].tolist()
