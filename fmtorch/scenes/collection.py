"""The collection family, after CPC: a landmark photographed by many people; other cameras, zooms, light and weather."""

from __future__ import annotations

import numpy as np

from fmtorch.scenes.buildings import (
    Style,
    ashlar,
    column,
    direction,
    foliage,
    front,
    house,
    marble,
    post,
    statue,
    tree,
    walker,
)
from fmtorch.scenes.camera import calibration, look_at
from fmtorch.scenes.light import Lens, Light, sun
from fmtorch.scenes.orbit import ground
from fmtorch.scenes.patterns import Rng, heaven, sign, to_pixels
from fmtorch.scenes.scene import Scene, Shot
from fmtorch.scenes.surfaces import Surfaces, vec
from fmtorch.scenes.textures import Real, pictures

SIZES = ((600, 800), (533, 800), (450, 800), (576, 768), (683, 1024), (480, 640))
LIGHTS = 4  # times of day


def _gable(surfaces: Surfaces, x: Real, y: Real, z: Real, width: Real, height: Real, deep: Real, stone: int) -> None:
    """A pediment: a triangular front and two roof planes."""
    left, right, top = vec(x, y, z), vec(x + width, y, z), vec(x + width / 2, y, z + height)
    uv = np.array([[0.0, 1.0], [1.0, 0.0], [0.5, -1.0]]) * np.array([3.0, 1.0])
    surfaces.piece(left, right - left, top - left, stone, uv, triangle=True, both_sides=True)
    back = vec(0, deep, 0)
    surfaces.quad(top + back, left - top, -back, stone, (0, 0, 2, 2), both_sides=True)
    surfaces.quad(top, right - top, back, stone, (0, 0, 2, 2), both_sides=True)


def _landmark(surfaces: Surfaces, rng: Rng, split: str) -> float:
    """A long front with many equal windows, a portico, perhaps towers; returns its width."""
    width, height = rng.uniform(24, 36), rng.uniform(9, 13)
    stone, block = marble(surfaces, rng), ashlar(surfaces, rng)
    style = Style(
        density=52, storey=rng.uniform(3.2, 4.4), bay=rng.uniform(2.6, 3.4), depth=0.4, pilasters=rng.random() < 0.5,
        same_windows=0.85,
    )  # fmt: skip
    front(surfaces, rng, split, vec(-width / 2, 0, 0), vec(1, 0, 0), width, height, style)
    end = vec(0, 14, 0)
    for x, along in ((-width / 2, -1), (width / 2, 1)):
        foot = vec(x, 0, 0) + (end if along < 0 else 0)
        front(surfaces, rng, split, foot, vec(0, along, 0), 14, height, Style(density=36, depth=0.3))
    portico = rng.uniform(8, 12)
    tall, out = min(height - 1.5, rng.uniform(6, 8)), rng.uniform(1.6, 2.8)
    for i in range(4):
        inset = 0.35 * i
        base = vec(-portico / 2 - 1.4 + inset, -out - 1.4 + inset, 0.16 * i)
        surfaces.box(
            base, vec(portico + 2.8 - 2 * inset, 0, 0), vec(0, out + 1.4 - inset, 0), 0.16, [block] * 5,
            ((0, 0, 2, 0.05),) * 4 + ((0, 0, 2, 1),),
        )  # fmt: skip
    for x in np.linspace(-portico / 2 + 0.5, portico / 2 - 0.5, int(rng.integers(4, 7))):
        column(surfaces, vec(float(x), -out + 0.5, 0.64), tall - 0.64, 0.42, stone)
    banner = surfaces.texture(to_pixels(sign(rng, 96, 1024)))
    surfaces.box(
        vec(-portico / 2, -out, tall), vec(portico, 0, 0), vec(0, out, 0), 1.0, [banner, block, block, block, stone],
        ((0, 0, 1, 1), (0, 0, 0.4, 0.2), (0, 0, 1, 0.2), (0, 0, 0.4, 0.2), (0, 0, 1, 1)),
    )  # fmt: skip
    _gable(surfaces, -portico / 2 - 0.3, -out - 0.1, tall + 1.0, portico + 0.6, rng.uniform(1.5, 2.6), out, block)
    if rng.random() < 0.6:
        for x in (-width / 2 - 1.0, width / 2 - 4.0):
            house(surfaces, rng, split, vec(x, -1.2, 0), vec(1, 0, 0), (5.0, 5.0, height + rng.uniform(3, 6)),
                  Style(density=52, storey=4.0, bay=2.5, depth=0.35))  # fmt: skip
    for x in np.linspace(-width / 2 + 2, width / 2 - 2, 6):
        if abs(x) > portico / 2 + 1.5:
            surfaces.box(
                vec(x - 0.7, -3.6, 0), vec(1.4, 0, 0), vec(0, 1.4, 0), 1.6, [block] * 5, ((0, 0, 0.25, 0.4),) * 5
            )
            statue(surfaces, rng, vec(x, -2.9, 1.6), 2.6, stone, detail=12)
    for picture in pictures(split, rng, 2):
        x = rng.uniform(-width / 2 + 1, width / 2 - 4)
        wide = 2.4
        tall_picture = wide * picture.shape[0] / picture.shape[1]
        number = surfaces.texture(picture)
        surfaces.quad(vec(x, -0.5, 1.4 + tall_picture), vec(wide, 0, 0), vec(0, 0, -tall_picture), number)
    return width


def scene(rng: Rng, split: str, shots: int, scale: Real) -> Scene:
    """A landmark with `shots` photographs by as many people; images are scaled by `scale`."""
    fixed = Surfaces()
    width = _landmark(fixed, rng, split)
    _surroundings(fixed, rng, split, width)
    lights, surfaces = _times_of_day(fixed, rng, width)
    taken = [_photograph(rng, width, scale, light=i % LIGHTS) for i in range(shots)]
    pairs = [(i, j) for i in range(shots) for j in range(i + 1, shots)]
    sky = heaven(rng, rng.uniform(-0.3, 0.7))
    return Scene(surfaces, lights, sky, taken, [pairs[k] for k in rng.permutation(len(pairs))])


def _surroundings(surfaces: Surfaces, rng: Rng, split: str, width: Real) -> None:
    """Ground, houses, trees and lamp posts beside a landmark of this width."""
    ground(surfaces, rng, split, 36)
    leaf, bark = foliage(surfaces, rng)
    for side in (-1, 1):
        right = vec(1, 0, 0)
        foot = vec(side * (width / 2 + 3) - (12 if side < 0 else 0), 4, 0)
        size = (12, 8, rng.uniform(7, 11))
        house(surfaces, rng, split, foot, right, size, Style(density=30, same_windows=0.8), sides="plain")
        for _ in range(3):
            at = vec(side * rng.uniform(width / 2 - 3, width / 2 + 8), -rng.uniform(2, 10), 0)
            tree(surfaces, rng, at, rng.uniform(4, 7), leaf, bark)
    metal = surfaces.texture(np.full((16, 16, 3), 70, dtype=np.uint8))
    for x in np.linspace(-width / 2, width / 2, 4):
        post(surfaces, vec(x, -8, 0), 4.5, metal)


def _times_of_day(fixed: Surfaces, rng: Rng, width: Real) -> tuple[list[Light], list[Surfaces]]:
    """The light at each time of day, and the surfaces then: what is fixed, and a crowd."""
    lights, surfaces = [], []
    azimuth = rng.uniform(200, 340)
    for k in range(LIGHTS):
        turn = azimuth + 35 * (k - 1.5) + rng.uniform(-10, 10)
        direct = rng.uniform(0.2, 1.0) if k else 1.0
        warm = rng.uniform(0, 0.3)
        lights.append(Light(
            sun(turn, rng.uniform(22, 60)), sun=(direct, direct * (0.97 - 0.3 * warm), direct * (0.9 - warm)),
            sky=(0.42, 0.44, 0.5), clouds=k,
        ))  # fmt: skip
        crowd = fixed.copy()
        for _ in range(22):
            at = vec(rng.normal(0, width / 3), -rng.uniform(3, 22), 0)
            walker(crowd, rng, at, rng.uniform(225, 315))
        surfaces.append(crowd)
    return lights, surfaces


def _photograph(rng: Rng, width: Real, scale: Real, light: int) -> Shot:
    """What somebody takes of a landmark of this width, with a camera of their own."""
    h, w = SIZES[int(rng.integers(len(SIZES)))]
    if rng.random() < 0.3:
        h, w = w, h
    size = (round(h * scale), round(w * scale))
    zoom = float(np.exp(rng.uniform(0, np.log(3.5))))
    K = calibration(0.85 * zoom * max(size), size)
    angle = -90 + float(np.clip(rng.normal(0, 36), -65, 65))
    distance = rng.uniform(14, 24) * (1 + 0.55 * (zoom - 1))
    eye = direction(angle) * distance + vec(0, 0, rng.uniform(1.5, 2.2))
    eye[1] = min(eye[1], -9.0)
    at = vec(rng.normal(0, 0.14 * width), 0, rng.uniform(3.0, 5.5))
    camera = look_at(K, size, eye.tolist(), at.tolist(), roll=float(rng.normal(0, 0.025)))
    lens = Lens(
        blur=rng.uniform(0.5, 1.2), exposure=rng.uniform(0.75, 1.4), contrast=rng.uniform(0.8, 1.3),
        gamma=rng.uniform(0.75, 1.3), noise=rng.uniform(2, 7), vignette=rng.uniform(0, 0.25),
        balance=(rng.uniform(0.9, 1.12), 1.0, rng.uniform(0.88, 1.12)),
    )  # fmt: skip
    return Shot(camera, lens, light=light, jpeg=int(rng.integers(45, 92)))
