"""The inner loop of the ray-caster, compiled: every piece against the pixels of its bounding box, row by row."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.arrays import B1x1, F4x1, F4x2, F4x3, I4x2, I8x1, I8x2, U1x1
from fmtorch.compiling.fused import fused
from fmtorch.compiling.kernel import inner, kernel

Floats = NDArray[np.float32]
Booleans = NDArray[np.bool_]
Real: TypeAlias = Any  # a number of Python's or NumPy's; in a compiled function each has one type
Index: TypeAlias = Any

_OPAQUE_FROM = 128  # of 255


class Pieces(NamedTuple):
    """n pieces as one camera sees them, and the order (k,) in which rays are cast against some of them, nearest first.

    boxes (n, 4): pixels x0, y0, x1, y1, end excluded. forms (n, 3, 3): of a pixel of the box, s z^-1, t z^-1, z^-1.
    depth (n, 3): along U, along V, at O. closest (n,): no point is nearer. triangle (n,).
    """

    order: I8x1
    boxes: I8x2
    forms: F4x3
    depth: F4x2
    closest: F4x1
    triangle: B1x1


class Cutouts(NamedTuple):
    """Where pieces have holes.

    place (n, 2): where the picture with holes begins in `opacity`, and its row length; -1: without holes. window
    (n, 10): u at O, along U, along V; v likewise; the picture's origin x, y and size x, y. opacity: of all pictures.
    """

    place: I8x2
    window: F4x2
    opacity: U1x1


class Bounds(NamedTuple):
    """Of s and t, exclusive, and of the depth."""

    low: np.float32
    high: np.float32
    near: np.float32


class Met(NamedTuple):
    """What the ray of each pixel (h, w) meets first so far: its depth, the piece's number, s and t."""

    depth: F4x2
    piece: I4x2
    s: F4x2
    t: F4x2


@kernel(always_compiled=True)
def cast_pieces(pieces: Pieces, cutouts: Cutouts, bounds: Bounds, met: Met) -> None:
    """Casts rays against pieces; what they meet -> met."""
    order, boxes, forms, depth, closest, triangle = pieces
    cutout, window, opacity = cutouts
    low, high, near = bounds
    buffer, piece, s, t = met
    width = buffer.shape[1]
    axis = np.arange(width).astype(np.float32)
    row_s, row_t, row_z = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    row_hit = np.empty(width, np.bool_)
    for k in range(len(order)):
        i = order[k]
        x0, y0, x1, y1 = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
        form, z_s, z_t, z_0 = forms[i], depth[i, 0], depth[i, 1], depth[i, 2]
        s_x, t_x, q_x = form[0, 0], form[1, 0], form[2, 0]
        is_triangle = triangle[i]
        if not _any_beyond(buffer[y0:y1, x0:x1], closest[i]):
            continue
        for y in range(y0, y1):
            before = buffer[y, x0:x1]
            from_top = np.float32(y - y0)
            s_y = form[0, 1] * from_top + form[0, 2]
            t_y = form[1, 1] * from_top + form[1, 2]
            q_y = form[2, 1] * from_top + form[2, 2]
            hits = 0
            for x in range(len(before)):
                q = q_x * axis[x] + q_y
                s_here = (s_x * axis[x] + s_y) / q
                t_here = (t_x * axis[x] + t_y) / q
                z = z_s * s_here + (z_t * t_here + z_0)
                edge = s_here + t_here if is_triangle else (s_here if s_here > t_here else t_here)
                hit = (s_here > low) & (t_here > low) & (edge < high) & (z < before[x]) & (z > near)
                row_s[x], row_t[x], row_z[x], row_hit[x] = s_here, t_here, z, hit
                hits += hit
            if hits == 0:
                continue
            if cutout[i, 0] >= 0:
                _open_holes(row_hit, row_s, row_t, len(before), opacity, cutout[i, 0], cutout[i, 1], window[i])
            here, here_s, here_t = piece[y, x0:x1], s[y, x0:x1], t[y, x0:x1]
            for x in range(len(before)):
                hit = row_hit[x]
                before[x] = row_z[x] if hit else before[x]
                here[x] = np.int32(i) if hit else here[x]
                here_s[x] = row_s[x] if hit else here_s[x]
                here_t[x] = row_t[x] if hit else here_t[x]


@inner
def _any_beyond(buffer: Floats, depth: Real) -> bool:
    """Whether a pixel's depth is `depth` or more."""
    for y in range(buffer.shape[0]):
        beyond = 0
        for x in range(buffer.shape[1]):
            beyond += buffer[y, x] >= depth
        if beyond > 0:
            return True
    return False


@inner
def _open_holes(
    hit: Booleans, s: Floats, t: Floats, n: int, opacity: NDArray[np.uint8], start: Index, stride: Index, window: Floats
) -> None:
    """Takes back the hits where the picture is transparent: its opacity, bilinearly, in 8 bits."""
    for x in range(n):
        if hit[x]:
            u = fused(fused(window[0], window[1], s[x]), window[2], t[x])
            v = fused(fused(window[3], window[4], s[x]), window[5], t[x])
            at_x = window[6] + (u - np.floor(u)) * window[8]
            at_y = window[7] + (v - np.floor(v)) * window[9]
            left, top = np.floor(at_x), np.floor(at_y)
            corner = start + np.int64(top) * stride + np.int64(left)
            a, b = np.float32(opacity[corner]), np.float32(opacity[corner + 1])
            c, d = np.float32(opacity[corner + stride]), np.float32(opacity[corner + stride + 1])
            above, below = fused(a, at_x - left, b - a), fused(c, at_x - left, d - c)
            hit[x] = np.rint(fused(above, at_y - top, below - above)) >= _OPAQUE_FROM
