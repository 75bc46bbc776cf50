"""Textures prefiltered for minification, and the photographs inside the scikit-image package that some of them show."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

Floats = NDArray[np.float32]
Pixels = NDArray[np.uint8]
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


class Texture:
    """A picture (h, w, 3) or, with opacity, (h, w, 4), sRGB in 8 bits; it repeats in both directions.

    Levels are halved in linear light, so that a surface keeps its brightness with distance; opacity is carried along.
    Raises ValueError for a picture that cannot be halved.
    """

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
        """The pyramid level at which opacity is looked up."""
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
        raise FileNotFoundError(
            f"{path} is absent: this installation of scikit-image does not hold it (release 0.26 does); "
            "nothing is downloaded"
        )
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
