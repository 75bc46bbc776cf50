"""Two nearest neighbours on a CPU: products of 8-bit integers first, then exact distances of those that may be nearest.

Rounding a descriptor moves it by a known distance, so by the triangle inequality its neighbours are among the few
whose rounded distances are small enough; nothing is approximate about the result.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from fmtorch.matching import nearest_kernels as compiled

BLOCK = 128  # rows whose products with all columns exist at a time: 4 MB at 8,000 columns
MAX_COMPUTED = 256  # exact distances a descriptor, beyond which rounding does not help: nearly equal ones
MAX_LENGTH = 1 << 10  # of a descriptor: products stay below 2^24, exact in float32, and squared distances below FAR
MAX_NORM = 2.0**25  # of a descriptor: differences fit 32 bits
_RANGE = 255  # between the least and the largest 8-bit integer


def two_nearest(rows: Tensor, columns: Tensor, block: int = BLOCK) -> compiled.Nearest | None:
    """Of integer-valued descriptors (n0, d), (n1, d), at most 2^25 in norm; None where rounding tells too few apart."""
    (n0, length), n1 = rows.shape, len(columns)
    if not 1 <= length <= MAX_LENGTH:
        return None
    bounds = [value.item() for each in (rows, columns) for value in each.aminmax()]
    low, high = min(bounds), max(bounds)
    if not max(-low, high) <= MAX_NORM:  # squares that overflow leave no sound scale
        return None
    fits = high - low <= _RANGE
    center, step = (low + 128, 1.0) if fits else ((low + high) / 2, (high - low) / _RANGE)
    padded = -(-n1 // compiled.GROUP) * compiled.GROUP
    rounded0, first = _rounded(rows, center, step, n0)
    rounded1, second = _rounded(columns, center, step, padded)
    neighbors = _nothing(n0, n1, padded)
    multiply = torch._int_mm if int8_products_are_exact() else _float_products
    transposed = rounded1.T
    if multiply is _float_products:
        rounded0, transposed = rounded0.float(), transposed.float().contiguous()
    computed, buffer = 0, torch.empty(min(block, n0), padded, dtype=torch.int32)
    for start in range(0, n0, block):
        products = buffer[: n0 - start]
        multiply(rounded0[start : start + block], transposed, out=products)
        computed += compiled.update(products.numpy(), start, first, second, neighbors)
        if computed > MAX_COMPUTED * (n0 + n1):
            return None
    return neighbors


@functools.cache
def int8_products_are_exact() -> bool:
    """Whether torch multiplies matrices of 8-bit integers exactly: it does not on processors without VNNI."""
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randint(-128, 128, (128, 256), generator=generator, dtype=torch.int8) for _ in range(2))
    try:
        return torch.equal(torch._int_mm(a, b.T), (a.float() @ b.T.float()).int())
    except (AttributeError, RuntimeError, NotImplementedError):
        return False


def _float_products(a: Tensor, b: Tensor, out: Tensor) -> None:
    """Products of integer-valued float32 matrices: exact, as sums below 2^24 are."""
    out.copy_(a @ b)


def _rounded(values: Tensor, center: float, step: float, padded: int) -> tuple[Tensor, compiled.Descriptors]:
    """The descriptors in 8 bits, with rows of zeros up to so many, and what the kernel is to know of them."""
    exact = values.int().numpy()
    rounded = torch.zeros(padded, values.shape[1], dtype=torch.int8)
    norms = np.full(padded, compiled.FAR, np.int32)
    error = compiled.round_to_8_bits(exact, float(center), float(step), rounded.numpy(), norms)
    return rounded, compiled.Descriptors(exact, norms, error * (1 + 1e-9), float(step))


def _nothing(n0: int, n1: int, padded: int) -> compiled.Nearest:
    """Nothing found: any distance improves it, but that of padding."""
    return compiled.Nearest(
        np.full(n0, -1), np.full(n0, np.inf), np.full(n0, np.inf), np.full(n1, -1), np.full(n1, np.inf),
        np.full(padded, compiled.FAR - 1, np.int32),
    )  # fmt: skip
