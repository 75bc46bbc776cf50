"""Orders of matches along space-filling (Morton) curves, in which neighbours in an image mostly stand together."""

import math
from typing import Any

import numpy as np

from fmtorch.jit.kernel import Array, B1x1, F4x2, I8x2, inner, kernel

_BITS = 15  # of each coordinate: a code of 30 bits
_CELLS = (1 << _BITS) - 1
_DIGIT = 10  # bits sorted by at a time
_PLACES = 1 << _DIGIT
CURVES = ((0.0, 0.0), (0.5, math.pi / 4))  # shift of the grid (in thirds of the extent) and rotation of each curve
CURVES32 = np.array([(shift, math.cos(angle), math.sin(angle)) for shift, angle in CURVES], np.float32)


@inner
def curve_order(x: Array, y: Array, shift: float, cosine: float, sine: float, order: Array) -> None:
    """The order of points x, y (n,) along a curve -> order (n,) i8.
    shift, cosine, sine: of the grid and of the rotation, in the type of the points."""
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


@inner
def curve_orders(rows: Array, orders: Array) -> None:
    """The order of matches (x0, y0, x1, y1, ...) along each curve, first of image 0, then of image 1 -> (c, m)."""
    m = orders.shape[1]
    for o in range(len(orders)):
        image, curve = o // len(CURVES32), o % len(CURVES32)
        curve_order(
            rows[2 * image, :m], rows[2 * image + 1, :m], CURVES32[curve, 0], CURVES32[curve, 1], CURVES32[curve, 2],
            orders[o],
        )  # fmt: skip


@inner
def put_in_order(rows: Array, order: Array, along: Array) -> None:
    """Columns of rows (d, n) in the order (m,) -> along (d, m)."""
    for k in range(len(rows)):
        for i in range(len(order)):
            along[k, i] = rows[k, order[i]]


@kernel
def slots_along_curves(x0: F4x2, x1: F4x2, mask: B1x1, out: I8x2) -> None:
    """The slots of the matches in the mask along each curve, those of the others last -> out (c, n)."""
    n, m, last = len(mask), 0, len(mask)
    rows, slot = np.empty((4, n), x0.dtype), np.empty(n, np.int64)
    for i in range(n):
        if mask[i]:
            rows[0, m], rows[1, m], rows[2, m], rows[3, m], slot[m] = x0[i, 0], x0[i, 1], x1[i, 0], x1[i, 1], i
            m += 1
        else:
            last -= 1
            for o in range(len(out)):
                out[o, last] = i
    orders = np.empty((len(out), m), np.int64)
    curve_orders(rows, orders)
    for o in range(len(out)):
        for k in range(m):
            out[o, k] = slot[orders[o, k]]
