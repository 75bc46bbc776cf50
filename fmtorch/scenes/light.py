"""How surfaces look: filtered texture, sun with shadows, sky light, and what a real camera adds."""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from fmtorch.jit.kernel import F4x1, F4x2, F4x3, I4x1, I8x1, U1x1, inner, kernel
from fmtorch.jit.lanes import fused
from fmtorch.scenes.raycast import Camera, Geometry, Index, Matrix, Met, Number
from fmtorch.scenes.surfaces import TO_LINEAR, Floats, Pixels, Real, Surfaces, bilinear, to_srgb

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
# The four rays of a pixel share a footprint's long side, so that each filters only a quarter of it.
_MINOR, _QUARTER, _FINEST = np.float32(0.6), np.float32(0.25), np.float32(1e-6)
_SKY, _UPWARD, _ROOF = np.float32(0.7), np.float32(0.3), np.float32(0.9)


class Seen(NamedTuple):
    """The surfaces that m pixels see: piece (m,), -1 for none, the place s, t (m,) on it, and the pieces' table.
    table (n, 3, 8): what is affine in s and t, at the corner and its change along both: texture u, v, shadow map x, y
    and distance, height, cosine to the sun, upwardness."""

    piece: I4x1
    s: F4x1
    t: F4x1
    table: F4x3


class Mapping(NamedTuple):
    """How pictures lie on n pieces: from pixel to texel, homography (n, 7), without the constant column.
    size (n, 2): of the piece's texture in texels. texture (n,): its number."""

    homography: F4x2
    size: F4x2
    texture: I4x1


class Footprints(NamedTuple):
    """Of each pixel (m,) the texels that its filter spans, then their binary logarithm, the pyramid level: `span`.
    foot: -2 x the height above ground, then the exponential of that: how near the ground, from 1 on."""

    span: F4x1
    foot: F4x1


class Picture(NamedTuple):
    """A texture's atlas in a row, see `Texture`, with its width, its channels, the origin and scale (levels, 2).
    Levels end before `coarsest`. to_linear (256,): linear light of 8-bit codes."""

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
    darker the foot of a wall is."""

    colours: F4x2
    shadow: F4x2
    shift_x: np.float32
    shift_y: np.float32
    bias: float
    ground_shade: np.float32


@kernel(always_compiled=True)
def footprints(seen: Seen, width: int, mapping: Mapping, out: Footprints, count: I8x1) -> None:
    """What is known of each pixel before transcendental functions are taken -> out.
    width: of the rows of pixels. count: pixels of each texture, added to."""
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
def _code(atlas: Pixels, corner: Index, beside: Index, below: Index, right: Number, down: Number) -> np.uint64:
    """One channel of a picture between four texels, rounded to 8 bits, as `cv2.remap` does.
    corner: place of the first texel's value; beside, below: how far on the next ones' are. Unsigned, as are colours:
    numba looks at signed places whether they count from the end."""
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


# Four rays a pixel, one on each row and column of a 4 x 4 grid (rotated grid); their mean is the pixel centre.
SAMPLES = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
SHADOW_MAP = 1400  # pixels


@dataclasses.dataclass(frozen=True)
class Light:
    """A sun (unit direction towards it), its strength, and the strength of the sky, in linear colour."""

    direction: tuple[Real, Real, Real]
    sun: tuple[Real, Real, Real] = (1.0, 0.95, 0.85)
    sky: tuple[Real, Real, Real] = (0.38, 0.42, 0.5)
    ground_shade: Real = 0.35  # how much darker the foot of a wall is: mild ambient occlusion
    through_walls: bool = False  # whether pieces lit from behind let the light in: a room seen without its ceiling
    clouds: int = 0  # turns the sky picture, so that photographs of different days differ


@dataclasses.dataclass(frozen=True)
class Lens:
    """Blur (standard deviation in pixels), exposure, contrast, gamma, white balance, noise, grey or colour."""

    blur: Real = 0.5
    exposure: Real = 1.0
    contrast: Real = 1.0
    gamma: Real = 1.0
    balance: tuple[Real, Real, Real] = (1.0, 1.0, 1.0)
    noise: Real = 1.5
    vignette: Real = 0.1
    grey: bool = False


class Stage:
    """A scene under one light: the shadow map and everything that is constant over cameras."""

    def __init__(self, geometry: Geometry, light: Light, sky: Pixels) -> None:
        self.geometry, self.light = geometry, light
        self.sky = np.roll(sky, light.clouds * sky.shape[1] // 5, axis=1)
        toward = np.array(light.direction, dtype=np.float64)
        toward /= np.linalg.norm(toward)
        points = geometry.corners.reshape(-1, 3)
        side = np.cross([0.0, 0.0, 1.0], toward)
        side /= np.linalg.norm(side)
        axes = np.stack([side, np.cross(toward, side), -toward])
        low, high = (points @ axes.T).min(0), (points @ axes.T).max(0)
        scale = (SHADOW_MAP - 1) / (high - low)[:2].max()
        self.bias = 2.0 / scale + 0.01
        P = np.vstack([np.column_stack([axes[:2], -low[:2]]) * scale, [0.0, 0.0, 0.0, 1.0]])
        depth = np.append(axes[2], -low[2])
        lit_from_behind = geometry.normal @ toward <= 0
        skip = lit_from_behind & ~geometry.both_sides if light.through_walls else None
        hits, _ = geometry.cast(P, depth, (SHADOW_MAP, SHADOW_MAP), None, skip)
        # Per piece: texture u v, shadow map x y and depth, height, cosine to the sun, upwardness; affine in (s, t).
        self.table = np.zeros((len(geometry.O), 3, 8), dtype=np.float32)
        self.table[..., :2] = geometry.uv
        world = np.stack([geometry.O, geometry.U, geometry.V], axis=1)
        self.table[..., 2:4] = world @ P[:2, :3].T
        self.table[:, 0, 2:4] += P[:2, 3]
        self.table[..., 4] = world @ depth[:3]
        self.table[:, 0, 4] += depth[3]
        self.table[..., 5] = world[..., 2]
        self.table[..., 6] = geometry.normals @ toward
        self.table[..., 7] = geometry.normals[..., 2]
        self.shadow: Floats = np.full((SHADOW_MAP, SHADOW_MAP), np.inf, dtype=np.float32)
        lit = hits.piece >= 0
        corner, right, down = self.table[..., 4][hits.piece[lit]].T
        self.shadow[lit] = corner + hits.s[lit] * right + hits.t[lit] * down

    def radiance(self, camera: Camera, offset: tuple[Real, Real]) -> Floats:
        hits, inverse = self.geometry.look(camera, offset)
        out = np.empty((*camera.size, 3), dtype=np.float32)
        beyond = np.flatnonzero(hits.piece.reshape(-1) < 0)
        out.reshape(-1, 3)[beyond] = self._background(camera, offset, beyond)
        self._shade(hits, inverse, offset, out.reshape(-1, 3))
        return out

    def _shade(self, hits: Met, inverse: Matrix, offset: tuple[Real, Real], out: Floats) -> None:
        """Linear colour of the pixels (h w, 3) that see a surface; NumPy takes the transcendental functions."""
        geometry = self.geometry
        seen = Seen(hits.piece.reshape(-1), hits.s.reshape(-1), hits.t.reshape(-1), self.table)
        footprint = Footprints(np.ones(len(seen.piece), np.float32), np.zeros(len(seen.piece), np.float32))
        count = np.zeros(len(geometry.textures), dtype=np.int64)
        mapping = Mapping(self.homography(inverse), geometry.texture_size.astype(np.float32), geometry.texture)
        footprints(seen, hits.piece.shape[1], mapping, footprint, count)
        np.log2(footprint.span, out=footprint.span)
        np.exp(footprint.foot, out=footprint.foot)
        end = np.cumsum(count)
        index = np.empty(end[-1], dtype=np.int32)
        group_by_texture(seen.piece, geometry.texture, end - count, index)
        lighting = Lighting(
            np.array([self.light.sun, self.light.sky], dtype=np.float32), self.shadow, 2 * np.float32(offset[0]),
            2 * np.float32(offset[1]), float(self.bias), np.float32(self.light.ground_shade),
        )  # fmt: skip
        for i in np.flatnonzero(count).tolist():
            texture = geometry.textures[i]
            levels = texture.origin, texture.scale, np.float32(texture.coarsest)
            _, width, channels = texture.atlas.shape
            picture = Picture(texture.atlas.reshape(-1), width, channels, *levels, TO_LINEAR)
            shade(index[end[i] - count[i] : end[i]], seen, footprint, picture, lighting, out)

    def homography(self, inverse: Matrix) -> Floats:
        """From pixel to texel, of each piece (n, 7): rows (2, 2) of the numerator, and G^-1's last, the denominator."""
        uv = self.geometry.uv * self.geometry.texture_size[:, None]
        numerator = np.einsum("nki,nkj->nij", uv[:, [1, 2, 0]], inverse)
        return np.concatenate([numerator[:, :, :2].reshape(-1, 4), inverse[:, 2]], axis=1).astype(np.float32)

    def _background(self, camera: Camera, offset: tuple[Real, Real], index: np.ndarray) -> Floats:
        """The sky (n, 3) at pixels (n,), at infinity: looked up by azimuth (once round) and elevation."""
        h, w = camera.size
        toward = camera.R.T @ np.linalg.inv(camera.K)
        x = np.take((np.arange(w) + offset[0]).astype(np.float32), index % w)
        y = np.take((np.arange(h) + offset[1]).astype(np.float32), index // w)
        X, Y, Z = (np.float32(r[0]) * x + (np.float32(r[1]) * y + np.float32(r[2])) for r in toward)
        tall, wide = self.sky.shape[:2]
        azimuth = np.arctan2(Y, X) * np.float32(wide / (2 * np.pi))
        elevation = np.arctan2(Z, np.hypot(X, Y)) * np.float32(2 / np.pi)
        coded = bilinear(self.sky, np.mod(azimuth, wide - 1), np.clip((1 - elevation) * (tall - 1), 0, tall - 1))
        return np.take(TO_LINEAR, coded)


def expose(stage: Stage, cameras: Sequence[Camera], lens: Lens, rng: np.random.Generator) -> Pixels:
    """The photograph (h, w, 3), or (h, w) if grey: the mean over the rays of a pixel and the exposure time.
    cameras: where the camera is during the exposure, four or more moments; one camera stands still."""
    moments = list(cameras) if len(cameras) > 1 else [cameras[0]] * len(SAMPLES)
    linear = np.zeros((*cameras[0].size, 3), dtype=np.float32)
    for i, camera in enumerate(moments):
        linear += stage.radiance(camera, SAMPLES[i % len(SAMPLES)])
    linear *= lens.exposure / len(moments)
    return develop(linear, lens, rng)


def develop(linear: Floats, lens: Lens, rng: np.random.Generator) -> Pixels:
    """From linear light to an 8-bit picture: lens blur, vignette, noise, tone curve."""
    h, w = linear.shape[:2]
    if lens.blur > 0:
        linear = cv2.GaussianBlur(linear, (0, 0), lens.blur).astype(np.float32)
    y, x = np.linspace(-1, 1, h, dtype=np.float32)[:, None], np.linspace(-1, 1, w, dtype=np.float32)
    darkening = (1 - np.float32(lens.vignette) * (x * x + y * y))[..., None]
    linear = linear * darkening * np.array(lens.balance, dtype=np.float32)
    if lens.grey:
        linear = (linear @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32))[..., None]
    # A shoulder instead of clipping, as film and cameras have it.
    tone = to_srgb(linear * (1 + 0.15 * linear) / (1 + linear * 0.45))
    tone = np.power(tone, np.float32(lens.gamma))
    tone = (tone - 0.5) * np.float32(lens.contrast) + 0.5
    grain = rng.standard_normal(tone.shape, dtype=np.float32) * np.float32(lens.noise / 255)
    grain *= 0.6 + 0.8 * np.sqrt(np.clip(tone, 0, 1))
    pixels = (np.clip(tone + grain, 0, 1) * 255 + 0.5).astype(np.uint8)
    return pixels[..., 0] if lens.grey else pixels


def sun(azimuth: Real, elevation: Real) -> tuple[float, float, float]:
    """The unit direction at an azimuth and elevation in degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    return float(np.cos(a) * np.cos(e)), float(np.sin(a) * np.cos(e)), float(np.sin(e))


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """One photograph to take. `camera` is the ground truth; `moments` the cameras during a long exposure."""

    camera: Camera
    lens: Lens
    light: int = 0
    moments: Sequence[Camera] = ()
    jpeg: int = 95  # quality


@dataclasses.dataclass(frozen=True, eq=False)
class DrawnScene:
    """Surfaces (a list for each light: what moves is not in all), lights, a sky, shots, pairs to try, best first."""

    surfaces: Sequence[Surfaces]
    lights: Sequence[Light]
    sky: Pixels
    shots: Sequence[Shot]
    pairs: Sequence[tuple[int, int]]


def shuffled_pairs(
    rng: np.random.Generator, shots: int, allowed: Callable[[int, int], bool] = lambda i, j: True
) -> list[tuple[int, int]]:
    """The pairs of shots that are allowed, in random order."""
    pairs = [(i, j) for i, j in itertools.combinations(range(shots), 2) if allowed(i, j)]
    return [pairs[k] for k in rng.permutation(len(pairs))]
