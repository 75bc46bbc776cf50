"""3 x 3 matrices (9,), row by row, compiled: products, inverses, orthogonal factors."""

from __future__ import annotations

import math

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.kernel import inner
from fmtorch.compiling.scratch import vector
from fmtorch.geometry.rank2_kernels import cofactors

POLAR_STEPS = 10  # quadratic once near; scaled, so that few are needed before


@inner
def multiply(A: Array, B: Array, out: Array) -> None:
    """A B -> out, another array."""
    for r in range(3):
        for c in range(3):
            out[3 * r + c] = A[3 * r] * B[c] + A[3 * r + 1] * B[3 + c] + A[3 * r + 2] * B[6 + c]


@inner
def invert(A: Array, out: Array) -> bool:
    """A^-1 -> out; False where there is none."""
    C = vector(9)
    cofactors(A, C)
    determinant = A[0] * C[0] + A[1] * C[1] + A[2] * C[2]
    for r in range(3):
        for c in range(3):
            out[3 * r + c] = C[3 * c + r] / determinant
    return determinant != 0 and math.isfinite(determinant)


@inner
def orthogonal_factor(A: Array) -> bool:
    """The rotation nearest to a positive or negative multiple of A, in place, by Newton's iteration (Higham 1986).

    False where A is singular.
    """
    C = vector(9)
    for _ in range(POLAR_STEPS):
        cofactors(A, C)
        determinant = A[0] * C[0] + A[1] * C[1] + A[2] * C[2]
        if not (determinant != 0 and math.isfinite(determinant)):
            return False
        squares, inverse = 0.0, 0.0
        for k in range(9):
            squares += A[k] * A[k]
            inverse += C[k] * C[k] / (determinant * determinant)
        scale = math.sqrt(math.sqrt(inverse / squares))
        scale = scale if determinant > 0 else -scale
        for k in range(9):
            A[k] = (scale * A[k] + C[k] / (determinant * scale)) / 2
    return True
