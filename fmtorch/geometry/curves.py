"""`curves` for the points of one pair, compiled."""

from typing import Any

import numpy as np

from fmtorch.jit.kernel import Array, inner

_BITS = 15  # of each coordinate: a code of 30 bits
_CELLS = (1 << _BITS) - 1
_DIGIT = 10  # bits sorted by at a time
_PLACES = 1 << _DIGIT


@inner
def curve_order(x: Array, y: Array, shift: float, cosine: float, sine: float, order: Array) -> None:
    """`curves.curve_order` of the turned points x, y (n,) -> order (n,) i8: the same numbers.

    shift, cosine, sine: of the grid and of the rotation, in the type of the points.
    """
    n = len(x)
    if n == 0:
        return
    u, v = np.empty_like(x), np.empty_like(y)
    for i in range(n):
        u[i] = cosine * x[i] - sine * y[i]
        v[i] = sine * x[i] + cosine * y[i]
    low_u, high_u, low_v, high_v = u[0], u[0], v[0], v[0]
    for i in range(n):
        low_u, high_u = min(low_u, u[i]), max(high_u, u[i])
        low_v, high_v = min(low_v, v[i]), max(high_v, v[i])
    kind = x.dtype.type
    extent = max(max(high_u - low_u, high_v - low_v), kind(1e-6))
    two, three, cells = kind(2), kind(3), kind(_CELLS)  # of the points' type, or the products would be float64
    key, sorted_key = np.empty(n, np.uint64), np.empty(n, np.uint64)
    for i in range(n):
        column = np.int64(((u[i] - low_u) / extent * two + shift) / three * cells)
        row = np.int64(((v[i] - low_v) / extent * two + shift) / three * cells)
        key[i] = ((_spread(column) | (_spread(row) << np.uint64(1))) << np.uint64(32)) | np.uint64(i)
    for digit in range(3):
        _sort_by_digit(key, sorted_key, np.uint64(32 + _DIGIT * digit))
        key, sorted_key = sorted_key, key
    for i in range(n):
        order[i] = np.int64(key[i] & np.uint64(0xFFFFFFFF))


@inner
def _spread(cell: Any) -> Any:
    """The 15 bits of a cell's number moved to the even positions."""
    v = np.uint64(cell) & np.uint64(_CELLS)
    v = (v | (v << np.uint64(8))) & np.uint64(0x00FF00FF)
    v = (v | (v << np.uint64(4))) & np.uint64(0x0F0F0F0F)
    v = (v | (v << np.uint64(2))) & np.uint64(0x33333333)
    return (v | (v << np.uint64(1))) & np.uint64(0x55555555)


@inner
def _sort_by_digit(key: Array, out: Array, low: Any) -> None:
    """Keys (n,) in the order of the ten bits from bit `low` on, equal ones as they stood -> out (n,)."""
    place = np.zeros(_PLACES + 1, np.int64)
    for i in range(len(key)):
        place[((key[i] >> low) & np.uint64(_PLACES - 1)) + np.uint64(1)] += 1
    for digit in range(_PLACES):
        place[digit + 1] += place[digit]
    for i in range(len(key)):
        digit = (key[i] >> low) & np.uint64(_PLACES - 1)
        out[place[digit]] = key[i]
        place[digit] += 1
