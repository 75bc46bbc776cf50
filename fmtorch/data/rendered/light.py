"""How surfaces look: filtered texture, sun with shadows, sky light, and what a real camera adds."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.data.rendered import light_kernels as compiled
from fmtorch.data.rendered.mipmap import TO_LINEAR, Floats, Pixels, Real, Texture, bilinear, to_srgb
from fmtorch.data.rendered.pinhole import Camera
from fmtorch.data.rendered.raycast import Geometry, Hits

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
        P = np.zeros((3, 4))
        P[:2, :3] = axes[:2] * scale
        P[:2, 3] = -low[:2] * scale
        P[2, 3] = 1.0
        depth = np.append(axes[2], -low[2])
        lit_from_behind = geometry.normal @ toward <= 0
        skip = lit_from_behind & ~geometry.both_sides if light.through_walls else None
        hits = geometry.cast(P, depth, (SHADOW_MAP, SHADOW_MAP), None, skip)
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
        compiled.affine(compiled.Seen(*hits.flat(), self.table), 4, self.shadow.reshape(-1))

    def radiance(self, camera: Camera, offset: tuple[Real, Real]) -> Floats:
        """Linear colour (h, w, 3) along the rays `offset` away from the pixel centres."""
        hits = self.geometry.look(camera, offset)
        out = np.empty((*camera.size, 3), dtype=np.float32)
        beyond = np.flatnonzero(hits.piece.reshape(-1) < 0)
        out.reshape(-1, 3)[beyond] = self._background(camera, offset, beyond)
        self._shade(hits, offset, out.reshape(-1, 3))
        return out

    def _shade(self, hits: Hits, offset: tuple[Real, Real], out: Floats) -> None:
        """Linear colour of the pixels (h w, 3) that see a surface; NumPy takes the transcendental functions."""
        geometry, seen = self.geometry, compiled.Seen(*hits.flat(), self.table)
        footprint = compiled.Footprints(np.ones(len(seen.piece), np.float32), np.zeros(len(seen.piece), np.float32))
        count = np.zeros(len(geometry.textures), dtype=np.int64)
        mapping = compiled.Mapping(self.homography(hits), geometry.texture_size.astype(np.float32), geometry.texture)
        compiled.footprints(seen, hits.piece.shape[1], mapping, footprint, count)
        np.log2(footprint.span, out=footprint.span)
        np.exp(footprint.foot, out=footprint.foot)
        end = np.cumsum(count)
        index = np.empty(end[-1], dtype=np.int32)
        compiled.group_by_texture(seen.piece, geometry.texture, end - count, index)
        lighting = compiled.Lighting(
            np.array([self.light.sun, self.light.sky], dtype=np.float32), self.shadow, 2 * np.float32(offset[0]),
            2 * np.float32(offset[1]), float(self.bias), np.float32(self.light.ground_shade),
        )  # fmt: skip
        for i in np.flatnonzero(count).tolist():
            compiled.shade(
                index[end[i] - count[i] : end[i]], seen, footprint, _picture(geometry.textures[i]), lighting, out
            )

    def homography(self, hits: Hits) -> Floats:
        """From pixel to texel, of each piece (n, 7): rows (2, 2) of the numerator, and G^-1's last, the denominator."""
        uv = self.geometry.uv * self.geometry.texture_size[:, None]
        numerator = np.einsum("nki,nkj->nij", uv[:, [1, 2, 0]], hits.inverse)
        return np.concatenate([numerator[:, :, :2].reshape(-1, 4), hits.inverse[:, 2]], axis=1).astype(np.float32)

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
