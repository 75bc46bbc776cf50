"""Order statistics and sorting, compiled."""

from __future__ import annotations

from typing import Any

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.kernel import inner


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
