"""The orbit family, after Tanks and Temples: a camera that walks round a structure; wide baselines, much occlusion."""

from __future__ import annotations

from typing import Literal

import numpy as np

from fmtorch.scenes.buildings import (
    Style,
    ashlar,
    column,
    direction,
    foliage,
    house,
    marble,
    post,
    rock,
    statue,
    tree,
    walker,
    wall_picture,
)
from fmtorch.scenes.camera import calibration, look_at
from fmtorch.scenes.light import Lens, Light, sun
from fmtorch.scenes.patterns import Rng, cells, colour, heaven, heights, masonry, meadow, poster, to_pixels
from fmtorch.scenes.scene import Scene, Shot
from fmtorch.scenes.surfaces import Surfaces, vec
from fmtorch.scenes.textures import Real, material, pictures

SIZE = (540, 960)
FOCAL = 760.0  # pixels: a phone's wide lens
ANGLES = (12.0, 75.0)  # degrees between the two views of a pair
SYMMETRIC = 0.6  # chance that the four sides look the same, as in many monuments


def ground(surfaces: Surfaces, rng: Rng, split: str, reach: Real) -> None:
    """A paved or grown square round the origin; its pictures repeat, with a lawn beyond."""
    lawn = material(split, "ground")
    if lawn is None or rng.random() < 0.5:
        lawn = to_pixels(meadow(rng, 512, 512, colour(rng, (0.16, 0.3), (0.3, 0.6), (0.35, 0.55))))
    number = surfaces.texture(lawn)
    far = 6 * reach
    surfaces.quad(vec(-far, far, -0.03), vec(2 * far, 0, 0), vec(0, -2 * far, 0), number, (0, 0, far / 2, far / 2))
    tint = colour(rng, (0.04, 0.12), (0.05, 0.3), (0.45, 0.75))
    if rng.random() < 0.5:
        paving = masonry(rng, 1024, 1024, 12, 12, tint, joint=0.03, bond=float(rng.choice([0.0, 0.5])), vary=0.09)
    else:
        paving = cells(rng, 1024, 1024, int(rng.integers(28, 60)), tint)
    number = surfaces.texture(to_pixels(paving))
    side = 9.0
    n = int(np.ceil(reach / side))
    for i in range(-n, n):
        for j in range(-n, n):
            surfaces.quad(vec(i * side, (j + 1) * side, 0), vec(side, 0, 0), vec(0, -side, 0), number)


def _structure(surfaces: Surfaces, rng: Rng, split: str) -> float:
    """The thing in the middle; returns its height."""
    stone, block = marble(surfaces, rng), ashlar(surfaces, rng)
    width, depth = rng.uniform(4.0, 6.0), rng.uniform(3.5, 6.0)
    sides: Literal["same", "twin"] = "twin"
    if rng.random() < SYMMETRIC:
        depth, sides = width, "same"
    base = 0.0
    for i in range(int(rng.integers(2, 4))):
        grow = 1.5 - 0.5 * i
        window = (0.0, 0.0, 1.0, 0.12)
        surfaces.box(
            vec(-width / 2 - grow, -depth / 2 - grow, base), vec(width + 2 * grow, 0, 0), vec(0, depth + 2 * grow, 0),
            0.32, [block, block, block, block, stone], (window, window, window, window, (0, 0, 2, 2)),
        )  # fmt: skip
        base += 0.32
    kind = rng.random()
    height = rng.uniform(2.8, 4.6)
    if kind < 0.45:  # a pavilion with columns round a core
        inner = 0.62
        house(
            surfaces, rng, split, vec(-width * inner / 2, -depth * inner / 2, base), vec(1, 0, 0),
            (width * inner, depth * inner, height), Style(density=110, storey=2.4, bay=1.7, depth=0.2), sides=sides,
        )  # fmt: skip
        for x in np.linspace(-width / 2 + 0.3, width / 2 - 0.3, 4):
            for y in np.linspace(-depth / 2 + 0.3, depth / 2 - 0.3, 4):
                if max(abs(x) / width, abs(y) / depth) > 0.4:
                    column(surfaces, vec(x, y, base), height, 0.17, stone, sides=8)
    else:
        house(
            surfaces, rng, split, vec(-width / 2, -depth / 2, base), vec(1, 0, 0), (width, depth, height),
            Style(density=110, storey=1.5, bay=1.1, depth=0.22, pilasters=kind < 0.75, same_windows=0.8), sides=sides,
        )  # fmt: skip
    base += height
    frieze = surfaces.texture(to_pixels(wall_picture(rng, split, 256, 1024, 60)))
    surfaces.box(
        vec(-width / 2 - 0.3, -depth / 2 - 0.3, base), vec(width + 0.6, 0, 0), vec(0, depth + 0.6, 0), 0.6,
        [frieze, frieze, frieze, frieze, stone], ((0, 0, 1, 0.6),) * 5,
    )  # fmt: skip
    base += 0.6
    if rng.random() < 0.5:  # a dome
        r = 0.36 * min(width, depth)
        profile = [(0.0, r * 1.05), (0.4, r)] + [
            (0.4 + r * float(np.sin(a)), r * float(np.cos(a)) + 1e-3) for a in np.linspace(0.1, np.pi / 2, 7)
        ]
        surfaces.lathe(vec(0, 0, base), profile, block, sides=16, repeat=(2, 1))
    else:
        statue(surfaces, rng, vec(0, 0, base), 2.2, stone)
    _boards_and_rocks(surfaces, rng, split, 0.5 * np.hypot(width, depth), block)
    return base


def _boards_and_rocks(surfaces: Surfaces, rng: Rng, split: str, reach: Real, back: int) -> None:
    """Painted boards and rocks round a structure that reaches so far; back: texture of the boards' other side."""
    paintings = [*pictures(split, rng, 2), to_pixels(poster(rng, 384, 288))]
    for k, picture in enumerate(paintings):
        angle = 120 * k + rng.uniform(-30, 30)
        foot = direction(angle) * (reach + rng.uniform(0.8, 2.2))
        right = direction(angle + 90 + rng.uniform(-30, 30))
        tall = 1.3
        wide = min(tall * picture.shape[1] / picture.shape[0], 2.0)
        number = surfaces.texture(picture)
        top = foot - right * wide / 2 + vec(0, 0, tall + 0.35)
        surfaces.quad(top, right * wide, vec(0, 0, -tall), number)
        surfaces.quad(top + right * wide, -right * wide, vec(0, 0, -tall), back)
    relief = surfaces.texture(to_pixels(wall_picture(rng, split, 256, 256, 90)))
    for _ in range(6):
        angle = rng.uniform(0, 360)
        foot = direction(angle) * (reach + rng.uniform(0.5, 2.5))
        rock(surfaces, rng, foot, rng.uniform(0.25, 0.7), relief, detail=9)


def _mound(surfaces: Surfaces, rng: Rng, texture: int, at: tuple[Real, Real], side: Real, tall: Real) -> None:
    """A flower bed or heap: a height field over a square."""
    n = 12
    rim = np.sin(np.linspace(0, np.pi, n))
    z = tall * heights(rng, n, n, 6) * np.outer(rim, rim)
    x, y = np.linspace(-side / 2, side / 2, n) + at[0], np.linspace(side / 2, -side / 2, n) + at[1]
    points = np.zeros((n, n, 3))
    points[..., 0], points[..., 1], points[..., 2] = x[None], y[:, None], z
    surfaces.grid(points, texture, (1, 1))


def surroundings(surfaces: Surfaces, rng: Rng, split: str, near: Real, far: Real, houses: int) -> None:
    """Houses, trees and lamp posts in a ring."""
    leaf, bark = foliage(surfaces, rng)
    for k in range(houses):
        angle = 360 / houses * k + rng.uniform(-8, 8)
        outward = direction(angle)
        width = rng.uniform(8, 14)
        right = np.cross(vec(0, 0, 1), -outward)
        foot = outward * rng.uniform(0.7 * far, far) - right * width / 2
        style = Style(density=30, storey=3.0, bay=2.8, depth=0.25, same_windows=0.8)
        house(surfaces, rng, split, foot, right, (width, 7.0, rng.uniform(6, 11)), style, sides="plain")
    for _ in range(9):
        at = direction(rng.uniform(0, 360)) * rng.uniform(near, far * 0.8)
        tree(surfaces, rng, at, rng.uniform(4, 8), leaf, bark)
    metal = surfaces.texture(to_pixels(np.full((32, 32, 3), 0.3, dtype=np.float32)))
    for _ in range(4):
        post(surfaces, direction(rng.uniform(0, 360)) * near, 4.2, metal)


def scene(rng: Rng, split: str, shots: int, scale: Real) -> Scene:
    """A structure with `shots` views round it; images are scaled by `scale`."""
    surfaces = Surfaces()
    height = _structure(surfaces, rng, split)
    ground(surfaces, rng, split, 22)
    surroundings(surfaces, rng, split, 17, 36, 8)
    leaf_bed = surfaces.texture(to_pixels(meadow(rng, 256, 256, colour(rng, (0.2, 0.95), (0.3, 0.6), (0.4, 0.6)))))
    for _ in range(3):
        a = np.radians(rng.uniform(0, 360))
        _mound(surfaces, rng, leaf_bed, (float(6.5 * np.cos(a)), float(6.5 * np.sin(a))), 2.4, 0.7)
    leaf, bark = foliage(surfaces, rng)
    for _ in range(5):
        tree(surfaces, rng, direction(rng.uniform(0, 360)) * rng.uniform(6.0, 8.5), rng.uniform(2.2, 3.6), leaf, bark)
    for _ in range(6):
        walker(surfaces, rng, direction(rng.uniform(0, 360)) * rng.uniform(5, 8), rng.uniform(0, 360))
    size = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    K = calibration(FOCAL * scale, size)
    arc = min(360.0, 20.0 * shots)
    start = rng.uniform(0, 360)
    azimuth = start + arc * (np.arange(shots) + rng.uniform(-0.3, 0.3, shots)) / shots
    taken = []
    for a in azimuth:
        radius = rng.uniform(9.5, 16.5)
        eye = direction(a) * radius + vec(0, 0, rng.uniform(1.3, 2.6))
        at = vec(*rng.normal(0, 0.7, 2), 0.42 * height + rng.normal(0, 0.3))
        camera = look_at(K, size, eye.tolist(), at.tolist(), roll=float(rng.normal(0, 0.03)))
        lens = Lens(exposure=float(rng.uniform(0.8, 1.2)), noise=3.0, blur=0.7)
        taken.append(Shot(camera, lens, jpeg=88))
    light = Light(sun(rng.uniform(0, 360), rng.uniform(30, 65)))
    apart = np.abs((azimuth[:, None] - azimuth[None] + 180) % 360 - 180)
    pairs = [(i, j) for i in range(shots) for j in range(i + 1, shots) if ANGLES[0] <= apart[i, j] <= ANGLES[1]]
    # Wide before narrow within each round, so that the pairs kept spread evenly over the angles.
    width = (ANGLES[1] - ANGLES[0]) / 4
    rounds: dict[int, int] = {}
    order = []
    for k in rng.permutation(len(pairs)):
        step = int((apart[pairs[k]] - ANGLES[0]) / width)
        rounds[step] = rounds.get(step, 0) + 1
        order.append((rounds[step], -step, pairs[k]))
    sky = heaven(rng, rng.uniform(-0.4, 0.6))
    return Scene([surfaces], [light], sky, taken, [pair for _, _, pair in sorted(order)])
