"""The null space of wide matrices by Householder reflections, component-first and element-wise over all samples."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import component_sum, sqrt

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
    remainders: list[Tensor] = []
    reflectors: list[tuple[Tensor, Tensor, Tensor]] = []
    rows = A
    for _ in range(m):
        # v = (head, tail) with head = row[0] + shift: its products with the rows follow from those with the row itself.
        row = rows[0]
        head, tail = row[0], row[1:]
        products = component_sum(rows * row, 1)
        remainder2 = products[0]
        norm = sqrt(torch.where(remainder2 > 0, remainder2, 1.0))
        shift = torch.copysign(norm, head)
        head = head + shift
        scale = 1.0 / (shift * head)
        reflectors.append((head, tail, scale))
        remainders.append(remainder2)
        below = rows[1:]
        projection = torch.addcmul(products[1:], below[:, 0], shift) * scale
        rows = torch.addcmul(below[:, 1:], projection[:, None], tail, value=-1)
    full_rank = (torch.stack(remainders) > tolerance * length2).all(0)
    basis = torch.eye(n - m, dtype=A.dtype, device=A.device)
    basis = basis.reshape(n - m, n - m, *[1] * (A.dim() - 2)).expand(n - m, n - m, *A.shape[2:])
    for head, tail, scale in reversed(reflectors):
        projection = component_sum(basis * tail, 1) * scale
        rest = torch.addcmul(basis, projection[:, None], tail, value=-1)
        basis = torch.cat([-(projection * head)[:, None], rest], 1)
    return basis, full_rank
