"""What a scene is made of: prefiltered textures on parallelograms and triangles, and the shapes built from them."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

Floats = NDArray[np.float32]
Pixels = NDArray[np.uint8]
Vector = NDArray[np.float64]
Real = float | int

_BORDER = 2
_ROW = 1024  # look-ups are arranged in rows of this length: cv2.remap limits the sides of its maps to 32,767

# sRGB's transfer curve (IEC 61966-2-1), from 8 bits to linear light.
_CODE = np.arange(256) / 255.0
TO_LINEAR: Floats = np.where(_CODE <= 0.04045, _CODE / 12.92, ((_CODE + 0.055) / 1.055) ** 2.4).astype(np.float32)


def to_srgb(linear: Floats) -> Floats:
    """Linear light in [0, 1] to sRGB in [0, 1]."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, np.float32(1 / 2.4)) - 0.055).astype(np.float32)


def to_pixels(picture: Floats) -> Pixels:
    """[0, 1] to 8 bits."""
    return (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)


class Texture:
    """A picture (h, w, 3) or, with opacity, (h, w, 4), sRGB in 8 bits; it repeats in both directions.
    Levels are halved in linear light, to keep brightness with distance. Raises ValueError where that is impossible."""

    def __init__(self, picture: Pixels) -> None:
        h, w = picture.shape[:2]
        if min(h, w) < 5:
            raise ValueError(f"a texture of {w} x {h} pixels; each side must have at least 5")
        self.opaque = picture.shape[2] == 3
        level = cv2.LUT(picture[..., :3], TO_LINEAR)
        alpha: Floats | None = None if self.opaque else np.float32(1 / 255) * picture[..., 3]
        levels = [picture]
        while min(h, w) > 4:
            h, w = h // 2, w // 2
            level = cv2.resize(level, (w, h), interpolation=cv2.INTER_AREA)
            coded = to_srgb(level.astype(np.float32, copy=False))
            if alpha is not None:
                alpha = cv2.resize(alpha, (w, h), interpolation=cv2.INTER_AREA).astype(np.float32)
                coded = np.dstack([coded, alpha])
            levels.append((coded * 255 + 0.5).astype(np.uint8))
        self.size = np.array(picture.shape[1::-1], dtype=np.float32)
        self.levels = len(levels)
        self.coarsest = self.levels - 1.001  # level that is looked up
        self.scale = np.array([level.shape[1::-1] for level in levels], dtype=np.float32)
        self.origin = np.zeros((len(levels), 2), dtype=np.float32)
        padded = [np.pad(level, ((_BORDER, _BORDER), (_BORDER, _BORDER), (0, 0)), mode="wrap") for level in levels]
        rest = sum(level.shape[0] for level in padded[1:])
        width = padded[0].shape[1] + max((level.shape[1] for level in padded[1:]), default=0)
        self.atlas = np.zeros((max(padded[0].shape[0], rest), width, picture.shape[2]), dtype=np.uint8)
        y = 0
        for i, level8 in enumerate(padded):
            x = 0 if i == 0 else padded[0].shape[1]
            y = 0 if i == 1 else y
            self.atlas[y : y + level8.shape[0], x : x + level8.shape[1]] = level8
            self.origin[i] = x + _BORDER - 0.5, y + _BORDER - 0.5
            y += level8.shape[0]

    def level(self, lod: float) -> int:
        return min(max(int(lod), 0), self.levels - 1)


def bilinear(picture: Pixels, x: Floats, y: Floats) -> Pixels:
    """Colours (n, c) of a picture at points (n,) and (n,) in pixels."""
    n = len(x)
    rows = max(1, -(-n // _ROW))
    maps = np.zeros((2, rows * _ROW), dtype=np.float32)
    maps[0, :n], maps[1, :n] = x, y
    table = maps.reshape(2, rows, _ROW)
    out = cv2.remap(picture, table[0], table[1], cv2.INTER_LINEAR)
    return out.reshape(rows * _ROW, -1)[:n].astype(np.uint8, copy=False)


# No photograph serves two splits; the motorcycle stays with `StereoPair`.
PICTURES = {
    "test": ("astronaut.png", "coffee.png", "hubble_deep_field.jpg", "coins.png", "page.png", "camera.png"),
    "train": ("chelsea.png", "rocket.jpg", "ihc.png", "retina.jpg", "text.png", "clock_motion.png", "moon.png"),
}
MATERIALS = {"test": {"stone": "brick.png", "ground": "grass.png"}, "train": {"stone": "gravel.png", "ground": ""}}


def skimage_file(name: str) -> Path:
    """The path of a file in scikit-image's data folder; FileNotFoundError names it where it is absent."""
    spec = importlib.util.find_spec("skimage")
    if spec is None or not spec.submodule_search_locations:
        raise FileNotFoundError(f"{name} belongs to the scikit-image package, which is not installed")
    path = Path(spec.submodule_search_locations[0]) / "data" / name
    if not path.is_file():
        reason = "this installation of scikit-image does not hold it (release 0.26 does); nothing is downloaded"
        raise FileNotFoundError(f"{path} is absent: {reason}")
    return path


def photograph(name: str) -> Pixels:
    """A photograph as RGB (h, w, 3)."""
    with Image.open(skimage_file(name)) as picture:
        return np.array(picture.convert("RGB"), dtype=np.uint8)


def pictures(split: str, rng: np.random.Generator, count: int) -> list[Pixels]:
    """Some of a split's photographs in random order, cropped and mirrored at random."""
    names = PICTURES[split]
    out = []
    for i in rng.permutation(max(count, len(names)))[:count]:
        picture = photograph(names[int(i) % len(names)])
        h, w = picture.shape[:2]
        part = rng.uniform(0.7, 1.0)
        ch, cw = int(h * part), int(w * part)
        y, x = int(rng.integers(h - ch + 1)), int(rng.integers(w - cw + 1))
        picture = picture[y : y + ch, x : x + cw]
        out.append(np.ascontiguousarray(picture[:, ::-1] if rng.random() < 0.5 else picture))
    return out


def material(split: str, kind: str) -> Pixels | None:
    """A photograph of `stone` or `ground`, made to repeat by mirroring; None where the split has none."""
    name = MATERIALS[split][kind]
    if not name:
        return None
    picture = photograph(name)
    picture = np.concatenate([picture, picture[:, ::-1]], axis=1)
    return np.ascontiguousarray(np.concatenate([picture, picture[::-1]], axis=0))


def vec(*v: Real) -> Vector:
    """A float64 vector."""
    return np.array(v, dtype=np.float64)


_FLAT = np.full(9, np.nan)  # stands for the normals of a flat piece until they are computed for all at once


class Surfaces:
    """A growing list of flat pieces: a corner O and edges U, V; their points are ``O + s U + t V``.
    s and t are in [0, 1]; in a triangle also s + t <= 1.
    Texture coordinates and normals are affine in (s, t), so that curved shapes can be shaded smoothly. The outside of a
    piece is where ``V x U`` points: seen from there, U goes right and V down, as in the picture on it."""

    def __init__(self) -> None:
        self.textures: list[Texture] = []
        self._rows: list[Vector] = []
        self._texture: list[int] = []
        self._flags: list[tuple[bool, bool]] = []

    def texture(self, picture: Pixels) -> int:
        self.textures.append(Texture(picture))
        return len(self.textures) - 1

    def paint(self, picture: Floats) -> int:
        """A texture of a picture in [0, 1]."""
        return self.texture(to_pixels(picture))

    def __len__(self) -> int:
        return len(self._rows)

    def piece(
        self, corner: Vector, U: Vector, V: Vector, texture: int, uv: Vector,
        *, triangle: bool = False, normals: Vector | None = None, both_sides: bool = False,
    ) -> None:  # fmt: skip
        """One piece; `uv` (3, 2) and `normals` (3, 3): values at the corner and their change along U and along V."""
        self._rows.append(np.concatenate([corner, U, V, uv.ravel(), _FLAT if normals is None else normals.ravel()]))
        self._texture.append(texture)
        self._flags.append((triangle, both_sides))

    def quad(
        self, corner: Vector, U: Vector, V: Vector, texture: int, window: Sequence[Real] = (0.0, 0.0, 1.0, 1.0),
        *, both_sides: bool = False,
    ) -> None:  # fmt: skip
        """A parallelogram that shows the part (u0, v0, u1, v1) of a texture."""
        u0, v0, u1, v1 = window
        self.piece(corner, U, V, texture, np.array([[u0, v0], [u1 - u0, 0.0], [0.0, v1 - v0]]), both_sides=both_sides)

    def box(
        self, base: Vector, right: Vector, back: Vector, height: Real, textures: Sequence[int],
        windows: Sequence[Sequence[Real]] = ((0.0, 0.0, 1.0, 1.0),) * 5,
    ) -> None:  # fmt: skip
        """An upright box on its lower front left corner; textures of front, right, back, left side and top."""
        up = vec(0.0, 0.0, height)
        corners = [base, base + right, base + right + back, base + back]
        for i, a in enumerate(corners):
            self.quad(a + up, corners[(i + 1) % 4] - a, -up, textures[i], windows[i])
        self.quad(base + back + up, right, -back, textures[4], windows[4])

    def grid(self, points: Vector, texture: int, repeat: tuple[Real, Real] = (1.0, 1.0)) -> None:
        """A smooth surface through a grid of points (m, n, 3), rows from top to bottom seen from outside."""
        m, n = points.shape[:2]
        du = np.gradient(points, axis=1)
        if np.allclose(points[:, 0], points[:, -1]):
            du[:, 0] = du[:, -1] = (points[:, 1] - points[:, -2]) / 2
        normal = np.cross(np.gradient(points, axis=0), du)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        v, u = np.meshgrid(np.linspace(0, repeat[1], m), np.linspace(0, repeat[0], n), indexing="ij")
        uv = np.stack([u, v], -1)
        for i in range(m - 1):
            for j in range(n - 1):
                for (a, b), step in (((i, j), 1), ((i + 1, j + 1), -1)):
                    corner, along, down = (a, b), (a, b + step), (a + step, b)
                    U, V = points[along] - points[corner], points[down] - points[corner]
                    if np.linalg.norm(np.cross(U, V)) < 1e-9:
                        continue
                    tex, nor = (np.stack([x[corner], x[along] - x[corner], x[down] - x[corner]]) for x in (uv, normal))
                    self.piece(points[corner], U, V, texture, tex, triangle=True, normals=nor)

    def lathe(
        self, base: Vector, profile: Sequence[tuple[Real, Real]], texture: int, sides: int = 12,
        repeat: tuple[Real, Real] = (1.0, 1.0), bumps: Vector | None = None,
    ) -> None:  # fmt: skip
        """A turned shape: (height, radius) from bottom to top round the upright axis; `bumps` scale the radius."""
        steps = np.array(profile[::-1], dtype=np.float64)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.stack([np.cos(angle), np.sin(angle)], -1)
        ring[-1] = ring[0]
        radius = np.repeat(steps[:, 1:2], sides + 1, axis=1)
        if bumps is not None:
            radius = radius * (1 + np.concatenate([bumps, bumps[:, :1]], axis=1))
        height = np.repeat(steps[:, :1], sides + 1, axis=1)
        self.grid(np.dstack([ring[None] * radius[..., None], height]) + base, texture, repeat)

    def copy(self) -> "Surfaces":
        """A list of its own with the same pieces and textures, to which more can be added."""
        other = Surfaces()
        for name, values in vars(self).items():
            setattr(other, name, list(values))
        return other

    def arrays(self) -> tuple[Vector, Vector, Vector, Vector, Vector]:
        """All pieces as arrays: O, U, V (n, 3), uv (n, 3, 2), normals (n, 3, 3)."""
        rows = np.array(self._rows).reshape(-1, 24)
        flat = np.isnan(rows[:, 15])
        normal = np.cross(rows[flat, 6:9], rows[flat, 3:6])
        rows[flat, 15:] = 0
        rows[flat, 15:18] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        uv, normals = rows[:, 9:15].reshape(-1, 3, 2), rows[:, 15:24].reshape(-1, 3, 3)
        return rows[:, 0:3], rows[:, 3:6], rows[:, 6:9], uv, normals

    def labels(self) -> tuple[NDArray[np.int32], NDArray[np.bool_], NDArray[np.bool_]]:
        """Per piece: number of its texture, whether it is a triangle, whether it is seen from both sides."""
        triangle, both_sides = np.array(self._flags, dtype=bool).reshape(-1, 2).T.copy()
        return np.array(self._texture, dtype=np.int32), triangle, both_sides
