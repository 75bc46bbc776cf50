"""Sorting in kernels, against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from fmtorch.geometry.arithmetic import smallest_but, sort_by


@pytest.mark.parametrize("m", [0, 1, 2, 3, 10, 200])
@pytest.mark.parametrize("different", [3, 10**9])
def test_keys_are_sorted_with_their_values_and_ties_by_these(m: int, different: int) -> None:
    rng = np.random.default_rng(m)
    key, value = rng.integers(0, different, m), rng.permutation(m)
    order = np.lexsort([value, key])
    expected = key[order], value[order]
    for k in range(0, m, 7):
        assert smallest_but(key.copy(), 0, m, k) == expected[0][k]
    sort_by(key, value)
    np.testing.assert_array_equal((key, value), expected)
