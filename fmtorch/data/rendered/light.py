"""How surfaces look: filtered texture, sun with shadows, sky light, and what a real camera adds."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling import switch
from fmtorch.data.rendered import light_kernels as compiled
from fmtorch.data.rendered.mipmap import TO_LINEAR, Floats, Pixels, Real, Texture, bilinear, to_srgb
from fmtorch.data.rendered.pinhole import Camera, Matrix
from fmtorch.data.rendered.raycast import Geometry, Hits

# Four rays a pixel, one on each row and column of a 4 x 4 grid (rotated grid); their mean is the pixel centre.
SAMPLES = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
_SHADOW_MAP = 1400  # pixels
_ANISOTROPY = 4.0  # the four rays share a footprint's long side, so each filters only a quarter of it


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
        scale = (_SHADOW_MAP - 1) / (high - low)[:2].max()
        self._bias = 2.0 / scale + 0.01
        P = np.zeros((3, 4))
        P[:2, :3] = axes[:2] * scale
        P[:2, 3] = -low[:2] * scale
        P[2, 3] = 1.0
        depth = np.append(axes[2], -low[2])
        lit_from_behind = geometry.normal @ toward <= 0
        skip = lit_from_behind & ~geometry.both_sides if light.through_walls else None
        hits = geometry.cast(P, depth, (_SHADOW_MAP, _SHADOW_MAP), None, skip)
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
        self.shadow: Floats = np.full((_SHADOW_MAP, _SHADOW_MAP), np.inf, dtype=np.float32)
        if switch.available():
            compiled.affine(compiled.Seen(*hits.flat(), self.table), 4, self.shadow.reshape(-1))
        else:
            met = self.table[hits.piece, :, 4]
            distance = met[..., 0] + hits.s * met[..., 1] + hits.t * met[..., 2]
            np.copyto(self.shadow, distance, where=hits.piece >= 0)

    def radiance(self, camera: Camera, offset: tuple[Real, Real]) -> Floats:
        """Linear colour (h, w, 3) along the rays `offset` away from the pixel centres."""
        hits = self.geometry.look(camera, offset)
        out = np.empty((*camera.size, 3), dtype=np.float32)
        beyond = np.flatnonzero(hits.piece.reshape(-1) < 0)
        out.reshape(-1, 3)[beyond] = self._background(camera, offset, beyond)
        if switch.available():
            self._shade_compiled(hits, offset, out.reshape(-1, 3))
        else:
            self._shade(hits, offset, out.reshape(-1, 3))
        return out

    def _shade_compiled(self, hits: Hits, offset: tuple[Real, Real], out: Floats) -> None:
        """As `_shade`, with the same results: NumPy takes the transcendental functions here too."""
        geometry, seen = self.geometry, compiled.Seen(*hits.flat(), self.table)
        footprint = compiled.Footprints(np.ones(len(seen.piece), np.float32), np.zeros(len(seen.piece), np.float32))
        count = np.zeros(len(geometry.textures), dtype=np.int64)
        mapping = compiled.Mapping(self._homography(hits), geometry.texture_size.astype(np.float32), geometry.texture)
        compiled.footprints(seen, hits.piece.shape[1], mapping, footprint, count)
        np.log2(footprint.span, out=footprint.span)
        np.exp(footprint.foot, out=footprint.foot)
        end = np.cumsum(count)
        index = np.empty(end[-1], dtype=np.int32)
        compiled.group_by_texture(seen.piece, geometry.texture, end - count, index)
        lighting = compiled.Lighting(
            np.array([self.light.sun, self.light.sky], dtype=np.float32), self.shadow, 2 * np.float32(offset[0]),
            2 * np.float32(offset[1]), float(self._bias), np.float32(self.light.ground_shade),
        )  # fmt: skip
        for i in np.flatnonzero(count).tolist():
            compiled.shade(
                index[end[i] - count[i] : end[i]], seen, footprint, _picture(geometry.textures[i]), lighting, out
            )

    def _shade(self, hits: Hits, offset: tuple[Real, Real], out: Floats) -> None:
        index = np.flatnonzero(hits.piece.ravel() >= 0)
        piece = hits.piece.ravel()[index]
        order = np.argsort(self.geometry.texture[piece], kind="stable")
        index, piece = index[order], piece[order]
        s, t = hits.s.ravel()[index], hits.t.ravel()[index]
        value = self.table[piece, 0]
        value += s[:, None] * self.table[piece, 1]
        value += t[:, None] * self.table[piece, 2]
        colour = self._albedo(hits, index, piece, s, t, value)
        colour *= self._irradiance(value, offset)
        out[index] = colour

    def _albedo(
        self, hits: Hits, index: NDArray[np.int64], piece: NDArray[np.int32], s: Floats, t: Floats, value: Floats
    ) -> Floats:
        """Filtered texture colour (n, 3); level of detail from the pixel's footprint in texels."""
        geometry = self.geometry
        rows = self._homography(hits)[piece]
        w = hits.piece.shape[1]
        y, x = (index // w).astype(np.float32), (index % w).astype(np.float32)
        z = 1 / (rows[:, 4] * x + rows[:, 5] * y + rows[:, 6])
        texel = value[:, :2] * geometry.texture_size.astype(np.float32)[piece]
        ux, vx = (rows[:, 0] - texel[:, 0] * rows[:, 4]) * z, (rows[:, 2] - texel[:, 1] * rows[:, 4]) * z
        uy, vy = (rows[:, 1] - texel[:, 0] * rows[:, 5]) * z, (rows[:, 3] - texel[:, 1] * rows[:, 5]) * z
        a, b, c = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
        half = np.sqrt(np.square((a - c) / 2) + b * b)
        major = np.sqrt((a + c) / 2 + half)
        minor = np.sqrt(np.maximum((a + c) / 2 - half, 0))
        lod = np.log2(np.maximum(np.maximum(minor * np.float32(0.6), major / np.float32(_ANISOTROPY)), 1e-6))
        bounds = np.searchsorted(geometry.texture[piece], np.arange(len(geometry.textures) + 1))
        colour = np.empty((len(piece), 3), dtype=np.float32)
        for i, texture in enumerate(geometry.textures):
            part = slice(bounds[i], bounds[i + 1])
            if bounds[i] < bounds[i + 1]:
                colour[part] = texture(value[part, 0], value[part, 1], lod[part])
        return colour

    def _homography(self, hits: Hits) -> Floats:
        """From pixel to texel, of each piece (n, 7): rows (2, 2) of the numerator, and G^-1's last, the denominator."""
        uv = self.geometry.uv * self.geometry.texture_size[:, None]
        numerator = np.einsum("nki,nkj->nij", uv[:, [1, 2, 0]], hits.inverse)
        return np.concatenate([numerator[:, :, :2].reshape(-1, 4), hits.inverse[:, 2]], axis=1).astype(np.float32)

    def _irradiance(self, value: Floats, offset: tuple[Real, Real]) -> Floats:
        """Light (n, 3): the sun where it is not shadowed, and the sky, less towards the ground and near it."""
        last = _SHADOW_MAP - 1
        x = np.clip(value[:, 2] + 2 * np.float32(offset[0]) + 0.5, 0, last).astype(np.int32)
        y = np.clip(value[:, 3] + 2 * np.float32(offset[1]) + 0.5, 0, last).astype(np.int32)
        lit = value[:, 4] - self.shadow.ravel()[y * _SHADOW_MAP + x] < self._bias
        sun = np.maximum(value[:, 6], 0) * lit
        foot = 1 - np.float32(self.light.ground_shade) * np.exp(-np.maximum(value[:, 5], 0) / 0.5)
        sky = (0.7 + 0.3 * value[:, 7]) * np.where(value[:, 7] > 0.9, 1, foot)
        light: Floats = sun[:, None] * np.array(self.light.sun, dtype=np.float32)
        light += sky[:, None] * np.array(self.light.sky, dtype=np.float32)
        return light

    def _background(self, camera: Camera, offset: tuple[Real, Real], index: NDArray[np.int64]) -> Floats:
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


def _picture(texture: Texture) -> compiled.Picture:
    _, wide, channels = texture.atlas.shape
    atlas, coarsest = texture.atlas.reshape(-1), np.float32(texture.coarsest)
    return compiled.Picture(atlas, wide, channels, texture.origin, texture.scale, coarsest, TO_LINEAR)


def expose(stage: Stage, cameras: Sequence[Camera], lens: Lens, rng: np.random.Generator) -> Pixels:
    """The photograph (h, w, 3), or (h, w) if grey: the mean over the rays of a pixel and the exposure time.

    cameras: where the camera is during the exposure, four or more moments; one camera stands still.
    """
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
    linear = (
        linear * (1 - np.float32(lens.vignette) * (x * x + y * y))[..., None] * np.array(lens.balance, dtype=np.float32)
    )
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


def points_seen(geometry: Geometry, camera: Camera) -> tuple[Matrix, Matrix]:
    """Pixels (n, 2) whose ray meets a surface, and the world points (n, 3) that they see, exactly."""
    depth = geometry.depth_map(camera)
    y, x = np.nonzero(np.isfinite(depth))
    pixel = np.stack([x, y], -1).astype(np.float64)
    rays = np.column_stack([pixel, np.ones(len(pixel))]) @ np.linalg.inv(camera.K).T
    return pixel, (rays * depth[y, x, None] - camera.t) @ camera.R
