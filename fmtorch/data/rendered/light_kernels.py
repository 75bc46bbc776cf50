"""How surfaces look, compiled: footprints of pixels on textures, filtered colours, light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import fused, inner, kernel
from fmtorch.data.rendered.raycast_kernels import Floats, Index, Real

Pixels = NDArray[np.uint8]

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_MINOR, _QUARTER, _FINEST = np.float32(0.6), np.float32(0.25), np.float32(1e-6)
_SKY, _UPWARD, _ROOF = np.float32(0.7), np.float32(0.3), np.float32(0.9)


@kernel("i4[::1], f4[::1], f4[::1], f4[:, :, ::1], i8, f4[::1]")
def affine(piece: NDArray[np.int32], s: Floats, t: Floats, table: Floats, column: Index, out: Floats) -> None:
    """One column of `table` (n, 3, c), at the corner and its change along s and t, at each pixel (m,) that is met."""
    for p in range(len(piece)):
        i = piece[p]
        if i >= 0:
            out[p] = table[i, 0, column] + s[p] * table[i, 1, column] + t[p] * table[i, 2, column]


@kernel("i4[::1], f4[::1], f4[::1], i8, f4[:, :, ::1], f4[:, ::1], f4[:, ::1], i4[::1], f4[::1], f4[::1], i8[::1]")
def footprints(
    piece: NDArray[np.int32], s: Floats, t: Floats, width: Index, table: Floats, homography: Floats, size: Floats,
    texture: NDArray[np.int32], side: Floats, foot: Floats, count: NDArray[np.int64],
) -> None:  # fmt: skip
    """What is known of each pixel before transcendental functions are taken.

    piece, s, t (m,): what is met, rows of `width` pixels. table (n, 3, 8): see `Stage`. homography (n, 7): from pixel
    to texel, without the constant column. size (n, 2): of the piece's texture in texels. texture (n,): its number.
    side (m,): the texels that the pixel's filter spans; foot (m,): -2 x the height above ground; both out.
    count: pixels of each texture, added to.
    """
    for p in range(len(piece)):
        i = piece[p]
        if i < 0:
            continue
        count[texture[i]] += 1
        value, form = table[i], homography[i]
        x, y = np.float32(p % width), np.float32(p // width)
        z = _ONE / (form[4] * x + form[5] * y + form[6])
        u = (value[0, 0] + s[p] * value[1, 0] + t[p] * value[2, 0]) * size[i, 0]
        v = (value[0, 1] + s[p] * value[1, 1] + t[p] * value[2, 1]) * size[i, 1]
        ux, vx = (form[0] - u * form[4]) * z, (form[2] - v * form[4]) * z
        uy, vy = (form[1] - u * form[5]) * z, (form[3] - v * form[5]) * z
        a, b, c = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
        difference, mean = (a - c) * _HALF, (a + c) * _HALF
        half = np.sqrt(difference * difference + b * b)
        major, minor = np.sqrt(mean + half), np.sqrt(max(mean - half, _ZERO))
        side[p] = max(max(minor * _MINOR, major * _QUARTER), _FINEST)
        height = value[0, 5] + s[p] * value[1, 5] + t[p] * value[2, 5]
        foot[p] = -max(height, _ZERO) * _TWO


@kernel("i4[::1], i4[::1], i8[::1], i4[::1]")
def group_by_texture(
    piece: NDArray[np.int32], texture: NDArray[np.int32], begin: NDArray[np.int64], index: NDArray[np.int32]
) -> None:
    """Pixels that are met, ordered by texture: of each the numbers from `begin` on, which is moved to their end."""
    for p in range(len(piece)):
        i = piece[p]
        if i >= 0:
            place = begin[texture[i]]
            index[place] = p
            begin[texture[i]] = place + 1


@inner
def _code(atlas: Pixels, corner: Index, beside: Index, below: Index, right: Real, down: Real) -> np.uint64:
    """One channel of a picture between four texels, rounded to 8 bits, as `cv2.remap` does.

    corner: place of the first texel's value; beside, below: how far on the next ones' are. Unsigned, as are colours:
    numba looks at signed places whether they count from the end.
    """
    a, b = np.float32(atlas[corner]), np.float32(atlas[corner + beside])
    c, d = np.float32(atlas[corner + below]), np.float32(atlas[corner + below + beside])
    left, farther = fused(a, right, b - a), fused(c, right, d - c)
    return np.uint64(np.rint(fused(left, down, farther - left)))


@kernel(
    "i4[::1], i4[::1], f4[::1], f4[::1], f4[:, :, ::1], f4[::1], f4[::1], u1[::1], i8, i8, f4[:, ::1], f4[:, ::1], f4,"
    "f4[::1], f4[:, ::1], f4, f4, f8, f4[:, ::1], f4, f4[:, ::1]"
)
def shade(
    index: NDArray[np.int32], piece: NDArray[np.int32], s: Floats, t: Floats, table: Floats, detail: Floats,
    foot: Floats, atlas: Pixels, across: Index, channels: Index, origin: Floats, scale: Floats, coarsest: Real,
    to_linear: Floats, shadow: Floats, shift_x: Real, shift_y: Real, bias: Real, light: Floats,
    ground_shade: Real, out: Floats,
) -> None:  # fmt: skip
    """Linear colour `out` (m, 3) of the pixels `index`, which all show one texture.

    detail (m,): pyramid level. foot (m,): how near the ground, from 1 on. atlas: see `Texture`, in a row, with its
    width, its channels, and the origin and scale of each level; levels end before `coarsest`. to_linear (256,): of
    8-bit codes. shadow: map of the distances that the sun reaches, looked up `shift` beside, lit if farther by less
    than `bias`. light (2, 3): sun and sky.
    """
    last = np.float32(shadow.shape[0] - 1)
    wide, beside = np.uint64(across), np.uint64(channels)
    below = wide * beside
    for k in range(len(index)):
        p = index[k]
        value, along, down = table[piece[p], 0], table[piece[p], 1], table[piece[p], 2]
        u = value[0] + s[p] * along[0] + t[p] * down[0]
        v = value[1] + s[p] * along[1] + t[p] * down[1]
        u, v = u - np.floor(u), v - np.floor(v)
        x = value[2] + s[p] * along[2] + t[p] * down[2] + shift_x + _HALF
        y = value[3] + s[p] * along[3] + t[p] * down[3] + shift_y + _HALF
        column, row = np.int64(min(max(x, _ZERO), last)), np.int64(min(max(y, _ZERO), last))
        distance = value[4] + s[p] * along[4] + t[p] * down[4]
        facing = value[6] + s[p] * along[6] + t[p] * down[6]
        upward = value[7] + s[p] * along[7] + t[p] * down[7]
        sun = max(facing, _ZERO) if np.float64(distance - shadow[row, column]) < bias else _ZERO
        sky = _SKY + _UPWARD * upward
        if upward <= _ROOF:
            sky *= _ONE - ground_shade * foot[p]
        level = coarsest  # also where the footprint is no number
        if detail[p] < coarsest:
            level = max(detail[p], _ZERO)
        low = np.int64(level)
        part = level - np.float32(low)
        x, y = origin[low, 0] + u * scale[low, 0], origin[low, 1] + v * scale[low, 1]
        x2, y2 = origin[low + 1, 0] + u * scale[low + 1, 0], origin[low + 1, 1] + v * scale[low + 1, 1]
        left, top, left2, top2 = np.floor(x), np.floor(y), np.floor(x2), np.floor(y2)
        right, lower, right2, lower2 = x - left, y - top, x2 - left2, y2 - top2
        corner = (np.uint64(top) * wide + np.uint64(left)) * beside
        corner2 = (np.uint64(top2) * wide + np.uint64(left2)) * beside
        for channel in range(3):
            place = np.uint64(channel)
            fine = to_linear[_code(atlas, corner + place, beside, below, right, lower)]
            coarse = to_linear[_code(atlas, corner2 + place, beside, below, right2, lower2)]
            colour = fine + (coarse - fine) * part
            out[p, channel] = colour * (sun * light[0, channel] + sky * light[1, channel])
