"""Arithmetic whose last bit depends on the values alone: not on padding, on the batch, or on memory layout.

Library reductions (`sum`, `matmul`, LAPACK) choose their order of summation by shape and alignment, and functions like
`exp`, even `torch.sqrt`, differ between processors and between the body and the tail of a vector. Here each order is
fixed, and made of sums, products, quotients and roots only, which are rounded correctly one by one.

Matrices come in two layouts: with the entries last, (*batch, 3, 3), as users have them, and component-first, (3, 3, *s)
or (9, *s) row by row, over which an operation on one entry runs over all matrices at once."""

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.jit.kernel import Array, inner

ROOT2, LOG2, LOG10 = math.sqrt(2), 0.6931471805599453, 2.302585092994046


@inner
def exponential(x: Any) -> Any:
    """exp(x) for |x| up to about 5: Pade's approximant of order 4 at x / 32, and five squarings. Of tensors, too."""
    y = x / 32
    y2 = y * y
    even, odd = 1680 + y2 * (180 + y2), y * (840 + 20 * y2)
    value = (even + odd) / (even - odd)
    for _ in range(5):
        value = value * value
    return value


@inner
def logarithm_kernel(x: float) -> Any:
    """ln(x) of a positive number: the series of atanh at the mantissa."""
    mantissa, exponent = math.frexp(x)
    m = mantissa * ROOT2
    return twice_atanh((m - 1) / (m + 1)) + (exponent - 0.5) * LOG2


@inner
def logarithm_1p_kernel(x: float) -> Any:
    """ln(1 + x) for x > -1, to rounding also near 0."""
    if -0.25 < x < 0.4:
        return twice_atanh(x / (x + 2))
    return logarithm_kernel(1 + x) if x < math.inf else x


@inner
def twice_atanh(z: Any) -> Any:
    """ln((1 + z) / (1 - z)) for |z| up to (sqrt 2 - 1) / (sqrt 2 + 1), to rounding, by its series. Of tensors, too."""
    z2 = z * z
    series = z2 * (1 / 19) + 1 / 17
    for k in range(15, 0, -2):
        series = series * z2 + 1 / k
    return 2 * z * series


def gradient_wanted(*inputs: object) -> bool:
    """Whether a graph is being recorded and one of the inputs is on it."""
    return torch.is_grad_enabled() and any(isinstance(x, Tensor) and x.requires_grad for x in inputs)


def weighted_sum(rows: Sequence[Tensor], weight: Tensor) -> Tensor:
    """The `stable_sum` of each row times the weight, whose gradient is summed row by row, in any batch alike."""
    return stable_sum(torch.stack([row * weight for row in rows]))


def stable_sum(x: Tensor, dim: int = -1) -> Tensor:
    """The sum over `dim` in a balanced binary tree that trailing zeros do not change.
    With h the largest power of two below n, element i is added to element i + h, then h is halved: the tree over the
    length rounded up to a power of two, in which absent elements are zeros. Padding with zeros, however long, leaves
    every bit as it is. The rounding error grows with log2(n)."""
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


SMALL = 1 << 13  # elements up to which a cumulative sum takes less time than one addition after the other


def component_sum(x: Tensor, dim: int = 0) -> Tensor:
    """The sum over a short axis of fixed length, in order; of float64 numbers of any layout the same bits.
    Small tensors are summed by a cumulative sum, which is sequential by definition: one call instead of many."""
    if x.numel() <= SMALL and x.dtype == torch.float64 and not x.is_cuda and not x.requires_grad:
        return x.cumsum(dim).select(dim, -1)
    first, *rest = x.unbind(dim)
    first = first + 0.0  # -0 becomes 0, as in a cumulative sum
    for part in rest:
        first = first + part
    return first


def outer_sum(a: Float[Tensor, " k *s"], b: Float[Tensor, " k *t"]) -> Tensor:
    """The sum over k, in order, of the products of a[k] and b[k], which broadcast; without the temporaries of a sum."""
    total: Tensor = a[0] * b[0]
    for a_k, b_k in zip(a[1:].unbind(0), b[1:].unbind(0), strict=True):
        total = torch.addcmul(total, a_k, b_k)
    return total


def matmul3(a: Float[Tensor, "*batch 3 3"], b: Float[Tensor, "*batch2 3 3"]) -> Float[Tensor, "*batch3 3 3"]:
    """The product of 3 x 3 matrices, batched, in a fixed order of summation."""
    return a[..., :, 0:1] * b[..., 0:1, :] + a[..., :, 1:2] * b[..., 1:2, :] + a[..., :, 2:3] * b[..., 2:3, :]


def as_rows(F: Float[Tensor, " 9 *s"]) -> Float[Tensor, " 3 3 *s"]:
    """Component-first entries as rows and columns."""
    return F.reshape(3, 3, *F.shape[1:])


def as_matrices(F: Float[Tensor, "9 p k"]) -> Float[Tensor, "p k 3 3"]:
    """Component-first entries as matrices."""
    return F.permute(1, 2, 0).reshape(*F.shape[1:], 3, 3)


def as_components(F: Float[Tensor, "p k 3 3"]) -> Float[Tensor, "9 p k"]:
    """Matrices as component-first entries."""
    return F.flatten(2).permute(2, 0, 1).contiguous()


def product(A: Float[Tensor, " a b *#s"], B: Float[Tensor, " b c *#s"]) -> Float[Tensor, " a c *#s"]:
    """``A B`` of component-first matrices of any size."""
    return component_sum(A[:, :, None] * B[None], 1)


def cross(a: Float[Tensor, " 3 *s"], b: Float[Tensor, " 3 *s"]) -> Float[Tensor, " 3 *s"]:
    """The cross product of component-first vectors."""
    return torch.linalg.cross(a, b, dim=0)  # type: ignore[no-any-return]


def cofactors(A: Float[Tensor, " 3 3 *s"]) -> Float[Tensor, " 3 3 *s"]:
    """The matrix of cofactors, ``det(A) A^-T`` where A is regular: row i is the cross product of the other two."""
    return torch.linalg.cross(A.roll(-1, 0), A.roll(-2, 0), dim=1)  # type: ignore[no-any-return]


def determinant(A: Float[Tensor, " 3 3 *s"]) -> Float[Tensor, "*s"]:
    """The determinant of component-first matrices."""
    return component_sum(A[0] * cross(A[1], A[2]))


def unit(x: Float[Tensor, " c *s"]) -> Float[Tensor, " c *s"]:
    """Scaled to unit norm over the components; NaN where that is not possible."""
    return x / sqrt(component_sum(x * x))


def sqrt(x: Tensor) -> Tensor:
    """The square root of float32 or float64 numbers, rounded correctly on every processor; NaN below zero.
    On a CPU by NumPy, which takes the processor's instruction, as kernels do: `torch.sqrt` asks a vector library, which
    on an AMD EPYC is an ulp off for every fifth float32 and every seventieth float64 number.
    The gradient is that of the root, and 0 instead of infinite where the root is 0."""
    wanted = torch.is_grad_enabled() and x.requires_grad
    return cast(Tensor, _Sqrt.apply(x)) if wanted else _sqrt(x)  # type: ignore[no-untyped-call]


class _Sqrt(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        value = _sqrt(x)
        ctx.save_for_backward(value)
        return value

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (value,) = ctx.saved_tensors
        zero = value == 0
        return torch.where(zero, 0.0, gradients[0] / torch.where(zero, 1.0, 2 * value))


def _sqrt(x: Tensor) -> Tensor:
    if x.device.type != "cpu":
        return x.sqrt()  # an instruction of the GPU, rounded correctly
    value = torch.empty_like(x)
    with np.errstate(invalid="ignore"):
        np.sqrt(x.detach().numpy(), out=value.numpy())
    return value


def logarithm(x: Tensor) -> Tensor:
    """ln(x) of positive numbers, to rounding, by arithmetic alone: the series of atanh at the mantissa."""
    mantissa, exponent = torch.frexp(x)
    m = mantissa * ROOT2
    return twice_atanh((m - 1) / (m + 1)) + (exponent.to(x.dtype) - 0.5) * LOG2  # type: ignore[no-any-return]


# Order statistics and sorting, compiled


@inner
def smallest_but(values: Array, begin: int, end: int, k: int) -> Any:
    """The k-th smallest, from 0, of values[begin:end], which are reordered (Hoare). No NaN."""
    low, high = begin, end - 1
    while low < high:
        pivot, i, j = values[(low + high) >> 1], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if begin + k <= j:
            high = j
        elif begin + k >= i:
            low = i
        else:
            break
    return values[begin + k]


@inner
def sort_by(key: Array, value: Array) -> None:
    """Sorts keys, ascending, and values along with them, where two have the same key by value (Shell)."""
    gap = 1
    while gap < len(key) // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, len(key)):
            k, v, j = key[i], value[i], i
            while j >= gap and (key[j - gap] > k or (key[j - gap] == k and value[j - gap] > v)):
                key[j], value[j] = key[j - gap], value[j - gap]
                j -= gap
            key[j], value[j] = k, v
        gap //= 3
