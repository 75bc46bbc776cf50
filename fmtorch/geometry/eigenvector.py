"""The eigenvector of the smallest eigenvalue of symmetric 9 x 9 (or other small) matrices, in fixed-order arithmetic.

`torch.linalg.eigh` rounds differently with the memory alignment of each matrix, so the same matrix gives different
last bits in different batch positions. This one does not.
"""

from typing import Any, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import component_sum, outer_sum, sqrt

SHIFT = 1e-14  # relative to the trace: above the rounding error of the factorisation, below any eigenvalue that counts
RANK_TOLERANCE = 1e-12  # relative to the trace: relative errors of 1e-6 in the rows that M was summed from
GAP = 1e-8  # relative to the trace: eigenvalue gaps below it have their gradient held finite
_SQUARINGS = 14  # the power 2^14 parts eigenvalues whose ratio is 0.998


def smallest_eigenvector(M: Float[Tensor, "*batch n n"]) -> tuple[Float[Tensor, "*batch n"], Bool[Tensor, "*batch"]]:
    """The unit eigenvector of the smallest eigenvalue of positive semi-definite M, and whether it is determined.

    Inverse iteration by repeated squaring: with M = L D L^T, the powers M^-1, M^-2, M^-4, ... (each at unit trace)
    turn into v v^T. The largest entry of v is positive. It counts as determined when the rank is at least n - 1, that
    is when the trace of M^-1 across v is not too large. M must be finite, float64.

    Gradient: with gaps g_j to the smallest eigenvalue, sum_j v_j v_j^T g_j / (g_j^2 + eps^2) over the other
    eigenvectors, finite where eigenvalues meet.
    """
    return cast(tuple[Tensor, Tensor], _SmallestEigenvector.apply(M))  # type: ignore[no-untyped-call]


class _SmallestEigenvector(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, M: Tensor) -> tuple[Tensor, Tensor]:
        v, determined = _inverse_power(M.movedim((-2, -1), (0, 1)).contiguous())
        v = v.movedim(0, -1).contiguous()
        ctx.save_for_backward(M, v)
        ctx.mark_non_differentiable(determined)
        return v, determined

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        M, v = ctx.saved_tensors
        trace = M.diagonal(dim1=-2, dim2=-1).sum(-1)
        values, vectors = torch.linalg.eigh(M / torch.where(trace > 0, trace, 1.0)[..., None, None])
        gap = values[..., 1:] - values[..., :1]
        bounded = gap / (gap * gap + GAP * GAP)
        others = vectors[..., 1:]
        along = bounded * (others.mT @ gradients[0][..., None])[..., 0]
        u = (others @ along[..., None])[..., 0] / torch.where(trace > 0, trace, 1.0)[..., None]
        outer: Tensor = u[..., :, None] * v[..., None, :]
        return -(outer + outer.mT) / 2


def _inverse_power(M: Tensor) -> tuple[Tensor, Tensor]:
    """`smallest_eigenvector` with the matrix axes first: (n, n, *s) to (n, *s)."""
    n = M.shape[0]
    trace = component_sum(M.diagonal(dim1=0, dim2=1).movedim(-1, 0))
    nonzero = trace > 0
    A = M / torch.where(nonzero, trace, 1.0)
    for i in range(n):
        A[i, i] += SHIFT
    inverse_of_L = torch.eye(n, dtype=M.dtype, device=M.device)
    inverse_of_L = inverse_of_L.reshape(n, n, *[1] * (M.dim() - 2)).repeat(1, 1, *M.shape[2:])
    pivots = []
    for i in range(n):
        pivot = A[0, 0].clamp_min(SHIFT / 2)
        column = A[1:, 0] / pivot
        inverse_of_L[i + 1 :, : i + 1] -= column[:, None] * inverse_of_L[i, : i + 1]
        A = A[1:, 1:] - column[:, None] * A[0, 1:]
        pivots.append(pivot)
    D = torch.stack(pivots)
    inverse = outer_sum((inverse_of_L / D[:, None])[:, :, None], inverse_of_L[:, None])
    size = _trace(inverse)
    X = inverse = inverse / size
    done = torch.zeros_like(nonzero)
    for _ in range(_SQUARINGS):
        squared = outer_sum(X[:, :, None], X[:, None])
        trace = _trace(squared)
        X = torch.where(done, X, squared / trace)
        done = done | (trace > 1 - 1e-14)
        if bool(done.all()):
            break
    best = X.diagonal(dim1=0, dim2=1).movedim(-1, 0).argmax(0)
    v = torch.gather(X, 0, best[None, None].expand(1, *X.shape[1:]))[0]
    v = v / sqrt(component_sum(v * v))
    across = (1 - component_sum(v * component_sum(inverse * v, 1))) * size  # the sum of 1 / eigenvalue over the others
    return v, nonzero & (across * RANK_TOLERANCE < 1)


def _trace(X: Tensor) -> Tensor:
    return component_sum(X.diagonal(dim1=0, dim2=1).movedim(-1, 0))
