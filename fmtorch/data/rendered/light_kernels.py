"""How surfaces look, compiled: footprints of pixels on textures, filtered colours, light."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.arrays import F4x1, F4x2, F4x3, I4x1, I8x1, U1x1
from fmtorch.compiling.fused import fused
from fmtorch.compiling.kernel import inner, kernel
from fmtorch.data.rendered.raycast_kernels import Index, Real

Pixels = NDArray[np.uint8]

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
# The four rays of a pixel share a footprint's long side, so that each filters only a quarter of it.
_MINOR, _QUARTER, _FINEST = np.float32(0.6), np.float32(0.25), np.float32(1e-6)
_SKY, _UPWARD, _ROOF = np.float32(0.7), np.float32(0.3), np.float32(0.9)


class Seen(NamedTuple):
    """The surfaces that m pixels see: piece (m,), -1 for none, the place s, t (m,) on it, and the pieces' table.

    table (n, 3, 8): what is affine in s and t, at the corner and its change along both: texture u, v, shadow map x, y
    and distance, height, cosine to the sun, upwardness.
    """

    piece: I4x1
    s: F4x1
    t: F4x1
    table: F4x3


class Mapping(NamedTuple):
    """How pictures lie on n pieces: from pixel to texel, homography (n, 7), without the constant column.

    size (n, 2): of the piece's texture in texels. texture (n,): its number.
    """

    homography: F4x2
    size: F4x2
    texture: I4x1


class Footprints(NamedTuple):
    """Of each pixel (m,) the texels that its filter spans, then their binary logarithm, the pyramid level: `span`.

    foot: -2 x the height above ground, then the exponential of that: how near the ground, from 1 on.
    """

    span: F4x1
    foot: F4x1


class Picture(NamedTuple):
    """A texture's atlas in a row, see `Texture`, with its width, its channels, the origin and scale (levels, 2).

    Levels end before `coarsest`. to_linear (256,): linear light of 8-bit codes.
    """

    atlas: U1x1
    across: int
    channels: int
    origin: F4x2
    scale: F4x2
    coarsest: np.float32
    to_linear: F4x1


class Lighting(NamedTuple):
    """Sun and sky: colours (2, 3), and a map of the distances that the sun reaches, shadow.

    The map is looked up `shift` pixels beside; what is farther by less than `bias` is lit. ground_shade: how much
    darker the foot of a wall is.
    """

    colours: F4x2
    shadow: F4x2
    shift_x: np.float32
    shift_y: np.float32
    bias: float
    ground_shade: np.float32


@kernel(always_compiled=True)
def affine(seen: Seen, column: int, out: F4x1) -> None:
    """One column of the table at each pixel (m,) that sees a surface."""
    piece, s, t, table = seen
    for p in range(len(piece)):
        i = piece[p]
        if i >= 0:
            out[p] = table[i, 0, column] + s[p] * table[i, 1, column] + t[p] * table[i, 2, column]


@kernel(always_compiled=True)
def footprints(seen: Seen, width: int, mapping: Mapping, out: Footprints, count: I8x1) -> None:
    """What is known of each pixel before transcendental functions are taken -> out.

    width: of the rows of pixels. count: pixels of each texture, added to.
    """
    piece, s, t, table = seen
    homography, size, texture = mapping
    side, foot = out
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


@kernel(always_compiled=True)
def group_by_texture(piece: I4x1, texture: I4x1, begin: I8x1, index: I4x1) -> None:
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


@kernel(always_compiled=True)
def shade(index: I4x1, seen: Seen, footprint: Footprints, picture: Picture, lighting: Lighting, out: F4x2) -> None:
    """Linear colour of the pixels `index`, which all show one picture -> out (m, 3)."""
    piece, s, t, table = seen
    detail, foot = footprint
    atlas, across, channels, origin, scale, coarsest, to_linear = picture
    light, shadow, shift_x, shift_y, bias, ground_shade = lighting
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
