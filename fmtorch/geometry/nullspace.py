"""The null space of wide matrices by Householder reflections, component-first and element-wise over all samples."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.reduce import component_sum

RANK_TOLERANCE = 64
"""A row counts as dependent on the rows before it when less than this many eps of its length is left over."""


def null_space(A: Float[Tensor, "m n *s"]) -> tuple[Float[Tensor, "k n *s"], Bool[Tensor, "*s"]]:
    """An orthonormal basis of the null space of m x n matrices, m < n, and whether the matrix has full rank m.

    The last k = n - m columns of Q in A^T = Q R (Golub and Van Loan, Matrix Computations, section 5.2); A^T A, whose
    condition is squared, is never formed. The matrix axes come first, so each operation runs over all samples at
    once, and a sample's result does not depend, in any bit, on the samples beside it. Where the rank is deficient the
    basis is finite but means nothing. Not scaled against overflow: entries should be of about unit size.
    """
    m, n = A.shape[:2]
    tolerance = (RANK_TOLERANCE * torch.finfo(A.dtype).eps) ** 2
    length2 = component_sum(A.detach() * A.detach(), 1)
    full_rank = torch.ones(A.shape[2:], dtype=torch.bool, device=A.device)
    reflectors: list[tuple[Tensor, Tensor]] = []
    rows = A
    for i in range(m):
        row, below = rows[0], rows[1:]
        remainder2 = component_sum(row * row)
        full_rank = full_rank & (remainder2 > tolerance * length2[i])
        norm = torch.where(remainder2 > 0, remainder2, 1.0).sqrt()
        head = row[0] + torch.copysign(norm, row[0])
        scale = 1.0 / (norm * head.abs())
        v = torch.cat([head[None], row[1:]])
        reflectors.append((v, scale))
        if i + 1 < m:
            projection = component_sum(below * v, 1) * scale
            rows = below[:, 1:] - projection[:, None] * v[1:]
    basis = torch.eye(n - m, dtype=A.dtype, device=A.device)
    basis = basis.reshape(n - m, n - m, *[1] * (A.dim() - 2)).expand(n - m, n - m, *A.shape[2:])
    for v, scale in reversed(reflectors):
        projection = component_sum(basis * v[1:], 1) * scale
        basis = torch.cat([-(projection * v[0])[:, None], basis - projection[:, None] * v[1:]], 1)
    return basis, full_rank
