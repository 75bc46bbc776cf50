"""Scratch arrays of kernels: numba compiles `np.empty` anew for each literal shape, an inner function but once."""

from __future__ import annotations

import numpy as np

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.kernel import inner


@inner
def vector(n: int) -> Array:
    """(n,) float64, not initialised."""
    return np.empty(n)


@inner
def matrix(rows: int, columns: int) -> Array:
    """(rows, columns) float64, not initialised."""
    return np.empty((rows, columns))
