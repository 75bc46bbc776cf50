"""Sums and products whose last bit depends on the values alone: not on padding, on the batch, or on memory layout.

Library reductions (`sum`, `matmul`, LAPACK) choose their order of summation by shape and alignment. Here each order is
fixed, and made of element-wise operations only, which are rounded correctly one by one.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def stable_sum(x: Tensor, dim: int = -1) -> Tensor:
    """The sum over `dim` in a balanced binary tree that trailing zeros do not change.

    With h the largest power of two below n, element i is added to element i + h, then h is halved: the tree over the
    length rounded up to a power of two, in which absent elements are zeros. Padding with zeros, however long, leaves
    every bit as it is. The rounding error grows with log2(n).
    """
    dim = dim % x.dim()
    n = x.shape[dim]
    if n == 0:
        return x.sum(dim)
    while n > 1:
        half = 1 << ((n - 1).bit_length() - 1)
        upper = x.narrow(dim, half, n - half)
        folded = x.narrow(dim, 0, n - half) + upper
        x = folded if n == 2 * half else torch.cat([folded, x.narrow(dim, n - half, 2 * half - n)], dim)
        n = half
    return x.squeeze(dim)


def component_sum(x: Tensor, dim: int = 0) -> Tensor:
    """The sum over a short axis of fixed length, in order: for few numbers this takes less time than a tree."""
    first, *rest = x.unbind(dim)
    for part in rest:
        first = first + part
    return first


def outer_sum(a: Float[Tensor, " k *s"], b: Float[Tensor, " k *t"]) -> Tensor:
    """The sum over k, in order, of the products of a[k] and b[k], which broadcast; without the temporaries of a sum."""
    total: Tensor = a[0] * b[0]
    for one, other in zip(a[1:].unbind(0), b[1:].unbind(0), strict=True):
        total = torch.addcmul(total, one, other)
    return total


def matmul3(a: Float[Tensor, "*batch 3 3"], b: Float[Tensor, "*batch2 3 3"]) -> Float[Tensor, "*batch3 3 3"]:
    """The product of 3 x 3 matrices, batched, in a fixed order of summation."""
    return a[..., :, 0:1] * b[..., 0:1, :] + a[..., :, 1:2] * b[..., 1:2, :] + a[..., :, 2:3] * b[..., 2:3, :]
