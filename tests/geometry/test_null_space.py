"""The null space of wide matrices, by the kernels' function interpreted."""

import numpy as np
import pytest
from scipy.linalg import null_space as scipy_null_space

from fmtorch.geometry import null_space as nullspace_kernels
from fmtorch.jit.lanes import LANES

EPS = np.finfo(np.float64).eps


def null_space(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bases (LANES, 9 - m, 9) of matrices (LANES, m, 9), and whether these have rank m (LANES,)."""
    m = A.shape[1]
    B = np.empty(((9 - m) * 9, LANES))
    full_rank = nullspace_kernels.null_space(A.reshape(LANES, -1).T.copy(), m, B, np.empty((m, LANES)))
    return B.T.reshape(LANES, 9 - m, 9), np.array(full_rank)


@pytest.mark.parametrize("m", [5, 7, 8])
def test_same_subspace_as_the_svd(m: int) -> None:
    A = np.random.default_rng(m).normal(size=(LANES, m, 9))
    bases, full_rank = null_space(A)
    assert full_rank.all()
    for basis, a in zip(bases, A, strict=True):
        theirs = scipy_null_space(a).T
        # Householder QR is backward stable with an error of a small multiple of m n eps, here 9 m eps; the subspace
        # moves by that times the condition number.
        bound = 9 * m * EPS
        np.testing.assert_allclose(basis @ basis.T, np.eye(9 - m), atol=bound)
        np.testing.assert_allclose(basis.T @ basis, theirs.T @ theirs, atol=bound * np.linalg.cond(a))


def test_rank_deficiency_is_seen() -> None:
    A = np.random.default_rng(0).normal(size=(LANES, 7, 9))
    A[0, 3] = A[0, 1]
    A[1, 5] = 0
    A[2, 6] = A[2, 0] - 2 * A[2, 4]
    A[3] = 0
    A[4, 2, 4] = np.nan
    bases, full_rank = null_space(A)
    assert full_rank.tolist() == [False] * 5 + [True] * (LANES - 5)
    assert np.isfinite(bases[[0, 1, 2, 3, *range(5, LANES)]]).all()
