"""Two nearest neighbours, compiled: products of 8-bit integers leave few candidates, whose distances are exact."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fmtorch.compiling.arrays import Array, F8x1, I1x2, I4x1, I4x2, I8x1
from fmtorch.compiling.kernel import inner, kernel

GROUP = 32  # columns that are passed over together where none can be a neighbour
FAR = 1 << 30  # squared 8-bit distance of a column of padding; those of others are less
_MAX_INT32 = 2**31 - 1


class Descriptors(NamedTuple):
    """Descriptors of an image, ``exact = center + step * rounded`` up to a distance of `error`.

    exact: (n, d) integers, at most 2^25 in norm. squared_norms: (n,) of the rounded ones, FAR for padding.
    """

    exact: I4x2
    squared_norms: I4x1
    error: float
    step: float


class Nearest(NamedTuple):
    """Neighbours and exact squared distances so far, (rows,) and (columns,); FAR-fetched ones are infinite.

    limit: (columns + padding,) the largest 8-bit squared distance at which a row may be nearer than `reverse`.
    """

    nearest: I8x1
    squared: F8x1
    second_squared: F8x1
    reverse: I8x1
    reverse_squared: F8x1
    limit: I4x1


@kernel
def round_to_8_bits(exact: I4x2, center: float, step: float, rounded: I1x2, squared_norms: I4x1) -> float:
    """Rounds descriptors (n, d) to 8 bits, in units of `step` from `center`, and returns the largest error's norm."""
    largest = 0.0
    for i in range(len(exact)):
        norm, error = 0, 0.0
        for k in range(exact.shape[1]):
            value = (exact[i, k] - center) / step
            nearest = min(max(np.rint(value), -128.0), 127.0)
            rounded[i, k] = np.int8(nearest)
            norm += int(nearest) * int(nearest)
            error += (value - nearest) * (value - nearest)
        squared_norms[i] = norm
        largest = max(largest, error)
    return math.sqrt(largest) * step


@kernel
def update(products: I4x2, first: int, rows: Descriptors, columns: Descriptors, neighbors: Nearest) -> int:
    """Takes products of rounded rows, from `first` on, with all rounded columns into what is found; overwrites them.

    A distance D and the distance D8 of what was rounded differ by the errors at most (triangle inequality), so that
    none beyond a bound on D8 needs to be computed. Returns how many were.
    """
    groups = products.shape[1] // GROUP
    minima = np.empty(groups, np.int32)
    error, step = rows.error + columns.error, rows.step
    computed = 0
    for i in range(len(products)):
        row, squared = first + i, products[i]
        norm, exact = rows.squared_norms[row], rows.exact[row]
        for g in range(groups):
            begin = g * GROUP
            smallest, excess = np.int32(_MAX_INT32), np.int32(_MAX_INT32)
            for j in range(begin, begin + GROUP):
                value = np.int32(np.int32(norm + columns.squared_norms[j]) - np.int32(2 * squared[j]))
                squared[j] = value
                smallest = min(smallest, value)
                excess = min(excess, np.int32(value - neighbors.limit[j]))
            minima[g] = smallest
            if excess <= 0:
                for j in range(begin, begin + GROUP):
                    if squared[j] <= neighbors.limit[j]:
                        distance = _squared_distance(exact, columns.exact[j])
                        computed += 1
                        if distance < neighbors.reverse_squared[j]:
                            neighbors.reverse[j], neighbors.reverse_squared[j] = row, distance
                            neighbors.limit[j] = _below(distance, error, step)
        computed += _search(row, squared, minima, rows, columns, neighbors)
    return computed


@inner
def _search(
    row: int, squared: Array, minima: Array, rows: Descriptors, columns: Descriptors, neighbors: Nearest
) -> int:
    """The two nearest columns of a row, by 8-bit squared distances and their minima in groups; what was computed."""
    error, step = rows.error + columns.error, rows.step
    limit = _reach(minima, error, step)
    best, second, nearest, computed = math.inf, math.inf, -1, 0
    for g in range(len(minima)):
        if minima[g] > limit:
            continue
        for j in range(g * GROUP, (g + 1) * GROUP):
            if squared[j] > limit:
                continue
            distance = _squared_distance(rows.exact[row], columns.exact[j])
            computed += 1
            if distance < best:
                best, second, nearest = distance, best, j
            elif distance < second:
                second = distance
            limit = min(limit, _below(second, error, step))
    neighbors.nearest[row], neighbors.squared[row], neighbors.second_squared[row] = nearest, best, second
    return computed


@inner
def _reach(minima: Array, error: float, step: float) -> int:
    """The largest 8-bit squared distance that either of the two nearest columns can have, by the minima of groups."""
    first, second = FAR - 1, FAR - 1
    for value in minima:
        if value < first:
            first, second = value, first
        elif value < second:
            second = value
    if error == 0:
        return second
    reach = (math.sqrt(second) + 2 * error / step) * (1 + 1e-9)
    return min(int(reach * reach), FAR - 1)


@inner
def _below(squared: float, error: float, step: float) -> int:
    """The largest 8-bit squared distance that a column can have whose exact one is less than this."""
    if squared == math.inf:
        return FAR - 1
    if error == 0:
        return int(squared / (step * step)) - 1
    reach = (math.sqrt(squared) + error) / step * (1 + 1e-9)
    return min(int(reach * reach), FAR - 1)


@inner
def _squared_distance(a: Array, b: Array) -> float:
    """|a - b|^2, exact: in integers, which add in any order."""
    total = np.int64(0)
    for k in range(len(a)):
        difference = np.int64(np.int32(a[k] - b[k]))
        total += difference * difference
    return float(total)
