"""Ray-casting and light in NumPy: piece by piece, and all pixels at once."""

import numpy as np

from fmtorch.scenes.light import SHADOW_MAP, Stage
from fmtorch.scenes.raycast import SEAM, Geometry, Matrix, Met, Pieces
from fmtorch.scenes.surfaces import TO_LINEAR, Texture, bilinear

Array = np.ndarray


def cast(geometry: Geometry, pieces: Pieces, near: np.float32, met: Met) -> None:
    h, w = met.piece.shape
    x_axis, y_axis = np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for i in pieces.order.tolist():
            x0, y0, x1, y1 = pieces.boxes[i].tolist()
            view = np.s_[y0:y1, x0:x1]
            before = met.depth[view]
            if before.max() < pieces.closest[i]:
                continue
            A = pieces.forms[i]
            rows = A[:, 1:2] * y_axis[: y1 - y0] + A[:, 2:]
            stq = A[:, 0, None, None] * x_axis[: x1 - x0] + rows[:, :, None]
            st = stq[:2]
            st /= stq[2]
            s, t = st
            z_s, z_t, z_0 = pieces.depth[i]
            z = z_s * s + (z_t * t + z_0)
            hit = (s > -SEAM) & (t > -SEAM) & (z < before) & (z > near)
            if geometry.triangle[i]:
                hit &= s + t < 1 + SEAM
            else:
                hit &= (s < 1 + SEAM) & (t < 1 + SEAM)
            if not geometry.textures[geometry.texture[i]].opaque:
                hit[hit] = _solid(geometry, i, s[hit], t[hit], (x1 - x0, y1 - y0))
            for target, value in ((before, z), (met.piece[view], np.int32(i)), (met.s[view], s), (met.t[view], t)):
                np.copyto(target, value, where=hit)


def _solid(geometry: Geometry, i: int, s: np.ndarray, t: np.ndarray, box: tuple[int, int]) -> np.ndarray:
    u, v = (_fused(_fused(a, b, s), c, t) for a, b, c in geometry.uv[i].T.astype(np.float32))
    texture = geometry.textures[geometry.texture[i]]
    level = np.full(u.shape, texture.level(geometry.detail(i, box)), dtype=np.int32)
    return _codes(texture, u - np.floor(u), v - np.floor(v), level)[:, 3] * np.float32(1 / 255) > 0.5


def _fused(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return (a + b.astype(np.float64) * c).astype(np.float32)


def _codes(texture: Texture, u: np.ndarray, v: np.ndarray, level: np.ndarray) -> np.ndarray:
    x = np.take(texture.origin[:, 0], level) + u * np.take(texture.scale[:, 0], level)
    y = np.take(texture.origin[:, 1], level) + v * np.take(texture.scale[:, 1], level)
    return bilinear(texture.atlas, x, y)


def colour(texture: Texture, u: np.ndarray, v: np.ndarray, lod: np.ndarray) -> np.ndarray:
    """Linear colour (n, 3) at u, v (1 = the whole picture, any real number) and pyramid level `lod` (n,)."""
    lod = np.clip(lod, 0.0, texture.coarsest)
    low = lod.astype(np.int32)
    u, v = u - np.floor(u), v - np.floor(v)
    fine, coarse = (np.take(TO_LINEAR, _codes(texture, u, v, level)[:, :3]) for level in (low, low + 1))
    return fine + (coarse - fine) * (lod - low.astype(np.float32))[:, None]


def shade(stage: Stage, hits: Met, inverse: Matrix, offset: tuple[float, float], out: np.ndarray) -> None:
    index = np.flatnonzero(hits.piece.ravel() >= 0)
    piece = hits.piece.ravel()[index]
    order = np.argsort(stage.geometry.texture[piece], kind="stable")
    index, piece = index[order], piece[order]
    s, t = hits.s.ravel()[index], hits.t.ravel()[index]
    value = stage.table[piece, 0]
    value += s[:, None] * stage.table[piece, 1]
    value += t[:, None] * stage.table[piece, 2]
    out[index] = _albedo(stage, inverse, index, piece, value, hits.piece.shape[1]) * _irradiance(stage, value, offset)


def _albedo(stage: Stage, inverse: Matrix, index: Array, piece: Array, value: Array, w: int) -> Array:
    """Filtered texture colour (n, 3); level of detail from the pixel's footprint in texels."""
    geometry = stage.geometry
    rows = stage.homography(inverse)[piece]
    y, x = (index // w).astype(np.float32), (index % w).astype(np.float32)
    z = 1 / (rows[:, 4] * x + rows[:, 5] * y + rows[:, 6])
    texel = value[:, :2] * geometry.texture_size.astype(np.float32)[piece]
    ux, vx = (rows[:, 0] - texel[:, 0] * rows[:, 4]) * z, (rows[:, 2] - texel[:, 1] * rows[:, 4]) * z
    uy, vy = (rows[:, 1] - texel[:, 0] * rows[:, 5]) * z, (rows[:, 3] - texel[:, 1] * rows[:, 5]) * z
    a, b, c = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    half = np.sqrt(np.square((a - c) / 2) + b * b)
    major = np.sqrt((a + c) / 2 + half)
    minor = np.sqrt(np.maximum((a + c) / 2 - half, 0))
    lod = np.log2(np.maximum(np.maximum(minor * np.float32(0.6), major / np.float32(4)), 1e-6))
    bounds = np.searchsorted(geometry.texture[piece], np.arange(len(geometry.textures) + 1))
    albedo = np.empty((len(piece), 3), dtype=np.float32)
    for i, texture in enumerate(geometry.textures):
        part = slice(bounds[i], bounds[i + 1])
        if bounds[i] < bounds[i + 1]:
            albedo[part] = colour(texture, value[part, 0], value[part, 1], lod[part])
    return albedo


def _irradiance(stage: Stage, value: np.ndarray, offset: tuple[float, float]) -> np.ndarray:
    """Light (n, 3): the sun where it is not shadowed, and the sky, less towards the ground and near it."""
    last = SHADOW_MAP - 1
    x = np.clip(value[:, 2] + 2 * np.float32(offset[0]) + 0.5, 0, last).astype(np.int32)
    y = np.clip(value[:, 3] + 2 * np.float32(offset[1]) + 0.5, 0, last).astype(np.int32)
    lit = value[:, 4] - stage.shadow.ravel()[y * SHADOW_MAP + x] < stage.bias
    sun = np.maximum(value[:, 6], 0) * lit
    foot = 1 - np.float32(stage.light.ground_shade) * np.exp(-np.maximum(value[:, 5], 0) / 0.5)
    sky = (0.7 + 0.3 * value[:, 7]) * np.where(value[:, 7] > 0.9, 1, foot)
    light = sun[:, None] * np.array(stage.light.sun, dtype=np.float32)
    return light + sky[:, None] * np.array(stage.light.sky, dtype=np.float32)
