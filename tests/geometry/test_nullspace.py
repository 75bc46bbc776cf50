from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.linalg import null_space as scipy_null_space

from fmtorch.geometry.nullspace import null_space


@pytest.mark.parametrize("m", [7, 8])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_same_subspace_as_the_svd(m, dtype, batch):
    A = torch.randn(m, 9, *batch, generator=torch.Generator().manual_seed(m), dtype=torch.float64).to(dtype)
    basis, full_rank = null_space(A)
    assert full_rank.all()
    assert basis.dtype == dtype
    for i in np.ndindex(batch):
        ours = basis[(..., *i)].double().numpy()
        a = A[(..., *i)].double().numpy()
        theirs = scipy_null_space(a).T
        # Householder QR is backward stable with an error of a small multiple of m n eps, here 9 m eps; the subspace
        # moves by that times the condition number.
        bound = 9 * m * torch.finfo(dtype).eps
        np.testing.assert_allclose(ours @ ours.T, np.eye(9 - m), atol=bound)
        np.testing.assert_allclose(ours.T @ ours, theirs.T @ theirs, atol=bound * np.linalg.cond(a))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rank_deficiency_is_seen(dtype):
    A = torch.randn(7, 9, 6, dtype=dtype)
    A[3, :, 0] = A[1, :, 0]
    A[5, :, 1] = 0
    A[6, :, 2] = A[0, :, 2] - 2 * A[4, :, 2]
    A[:, :, 3] = 0
    A[2, 4, 4] = torch.nan
    basis, full_rank = null_space(A)
    assert full_rank.tolist() == [False] * 5 + [True]
    assert basis[..., [0, 1, 2, 3, 5]].isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bits_do_not_depend_on_the_neighbours(dtype):
    A = torch.randn(7, 9, 203, dtype=dtype)
    basis, _ = null_space(A)
    for start, count in ((0, 1), (1, 2), (5, 17), (3, 200)):
        assert torch.equal(null_space(A[..., start : start + count].contiguous())[0], basis[..., start : start + count])
        assert torch.equal(null_space(A[..., start : start + count])[0], basis[..., start : start + count])
    assert torch.equal(null_space(A.reshape(7, 9, 7, 29))[0], basis.reshape(2, 9, 7, 29))


def test_gradient_of_the_projector():
    A = torch.randn(7, 9, 2, dtype=torch.float64, requires_grad=True)

    def projector(A):
        basis = null_space(A)[0]
        return (basis[:, :, None] * basis[:, None]).sum(0)

    assert torch.autograd.gradcheck(projector, (A,))
    zero = torch.zeros(7, 9, 1, dtype=torch.float64, requires_grad=True)
    null_space(zero)[0].square().sum().backward()
    assert zero.grad is not None
    assert zero.grad.isfinite().all()
