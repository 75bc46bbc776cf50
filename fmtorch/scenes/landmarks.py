"""The families of landmarks: a walk round a structure after Tanks and Temples, and photographs of a place after CPC."""

from collections import Counter
from typing import Literal

import numpy as np

from fmtorch.scenes import buildings
from fmtorch.scenes.buildings import Style, direction
from fmtorch.scenes.light import DrawnScene, Lens, Light, Shot, shuffled_pairs, sun
from fmtorch.scenes.patterns import Rng, cells, colour, heaven, heights, masonry, meadow, poster, sign
from fmtorch.scenes.raycast import calibration, look_at, scaled_camera
from fmtorch.scenes.surfaces import Real, Surfaces, material, pictures, to_pixels, vec

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
    number = surfaces.paint(paving)
    side = 9.0
    n = int(np.ceil(reach / side))
    for i in range(-n, n):
        for j in range(-n, n):
            surfaces.quad(vec(i * side, (j + 1) * side, 0), vec(side, 0, 0), vec(0, -side, 0), number)


def _structure(surfaces: Surfaces, rng: Rng, split: str) -> float:
    stone, block = buildings.marble(surfaces, rng), buildings.ashlar(surfaces, rng)
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
        buildings.house(
            surfaces, rng, split, vec(-width * inner / 2, -depth * inner / 2, base), vec(1, 0, 0),
            (width * inner, depth * inner, height), Style(density=110, storey=2.4, bay=1.7, depth=0.2), sides=sides,
        )  # fmt: skip
        for x in np.linspace(-width / 2 + 0.3, width / 2 - 0.3, 4):
            for y in np.linspace(-depth / 2 + 0.3, depth / 2 - 0.3, 4):
                if max(abs(x) / width, abs(y) / depth) > 0.4:
                    buildings.column(surfaces, vec(x, y, base), height, 0.17, stone, sides=8)
    else:
        buildings.house(
            surfaces, rng, split, vec(-width / 2, -depth / 2, base), vec(1, 0, 0), (width, depth, height),
            Style(density=110, storey=1.5, bay=1.1, depth=0.22, pilasters=kind < 0.75, same_windows=0.8), sides=sides,
        )  # fmt: skip
    base += height
    frieze = surfaces.paint(buildings.wall_picture(rng, split, 256, 1024, 60))
    surfaces.box(
        vec(-width / 2 - 0.3, -depth / 2 - 0.3, base), vec(width + 0.6, 0, 0), vec(0, depth + 0.6, 0), 0.6,
        [frieze, frieze, frieze, frieze, stone], ((0, 0, 1, 0.6),) * 5,
    )  # fmt: skip
    base += 0.6
    if rng.random() < 0.5:  # a dome
        r = 0.36 * min(width, depth)
        cap = [(0.4 + r * float(np.sin(a)), r * float(np.cos(a)) + 1e-3) for a in np.linspace(0.1, np.pi / 2, 7)]
        surfaces.lathe(vec(0, 0, base), [(0.0, r * 1.05), (0.4, r), *cap], block, sides=16, repeat=(2, 1))
    else:
        buildings.statue(surfaces, rng, vec(0, 0, base), 2.2, stone)
    _boards_and_rocks(surfaces, rng, split, 0.5 * np.hypot(width, depth), block)
    return base


def _boards_and_rocks(surfaces: Surfaces, rng: Rng, split: str, reach: Real, back: int) -> None:
    """Painted boards and rocks round a structure that reaches so far; back: texture of the boards' other side."""
    for k, picture in enumerate([*pictures(split, rng, 2), to_pixels(poster(rng, 384, 288))]):
        angle = 120 * k + rng.uniform(-30, 30)
        foot = direction(angle) * (reach + rng.uniform(0.8, 2.2))
        right = direction(angle + 90 + rng.uniform(-30, 30))
        tall = 1.3
        wide = min(tall * picture.shape[1] / picture.shape[0], 2.0)
        number = surfaces.texture(picture)
        top = foot - right * wide / 2 + vec(0, 0, tall + 0.35)
        surfaces.quad(top, right * wide, vec(0, 0, -tall), number)
        surfaces.quad(top + right * wide, -right * wide, vec(0, 0, -tall), back)
    relief = surfaces.paint(buildings.wall_picture(rng, split, 256, 256, 90))
    for _ in range(6):
        angle = rng.uniform(0, 360)
        foot = direction(angle) * (reach + rng.uniform(0.5, 2.5))
        buildings.rock(surfaces, rng, foot, rng.uniform(0.25, 0.7), relief, detail=9)


def _mound(surfaces: Surfaces, rng: Rng, texture: int, at: tuple[Real, Real], side: Real, tall: Real) -> None:
    n = 12
    rim = np.sin(np.linspace(0, np.pi, n))
    z = tall * heights(rng, n, n, 6) * np.outer(rim, rim)
    x, y = np.linspace(-side / 2, side / 2, n) + at[0], np.linspace(side / 2, -side / 2, n) + at[1]
    surfaces.grid(np.stack([*np.meshgrid(x, y), z], -1), texture, (1, 1))


def surroundings(surfaces: Surfaces, rng: Rng, split: str, near: Real, far: Real, houses: int) -> None:
    """Houses, trees and lamp posts in a ring."""
    leaf, bark = buildings.foliage(surfaces, rng)
    for k in range(houses):
        angle = 360 / houses * k + rng.uniform(-8, 8)
        outward = direction(angle)
        width = rng.uniform(8, 14)
        right = np.cross(vec(0, 0, 1), -outward)
        foot = outward * rng.uniform(0.7 * far, far) - right * width / 2
        style = Style(density=30, storey=3.0, bay=2.8, depth=0.25, same_windows=0.8)
        buildings.house(surfaces, rng, split, foot, right, (width, 7.0, rng.uniform(6, 11)), style, sides="plain")
    for _ in range(9):
        at = direction(rng.uniform(0, 360)) * rng.uniform(near, far * 0.8)
        buildings.tree(surfaces, rng, at, rng.uniform(4, 8), leaf, bark)
    metal = surfaces.paint(np.full((32, 32, 3), 0.3, dtype=np.float32))
    for _ in range(4):
        buildings.post(surfaces, direction(rng.uniform(0, 360)) * near, 4.2, metal)


def orbit_scene(rng: Rng, split: str, shots: int, scale: Real) -> DrawnScene:
    """A structure with `shots` views round it; images are scaled by `scale`."""
    surfaces = Surfaces()
    height = _structure(surfaces, rng, split)
    ground(surfaces, rng, split, 22)
    surroundings(surfaces, rng, split, 17, 36, 8)
    leaf_bed = surfaces.paint(meadow(rng, 256, 256, colour(rng, (0.2, 0.95), (0.3, 0.6), (0.4, 0.6))))
    for _ in range(3):
        a = np.radians(rng.uniform(0, 360))
        _mound(surfaces, rng, leaf_bed, (float(6.5 * np.cos(a)), float(6.5 * np.sin(a))), 2.4, 0.7)
    leaf, bark = buildings.foliage(surfaces, rng)
    for _ in range(5):
        foot = direction(rng.uniform(0, 360)) * rng.uniform(6.0, 8.5)
        buildings.tree(surfaces, rng, foot, rng.uniform(2.2, 3.6), leaf, bark)
    for _ in range(6):
        buildings.walker(surfaces, rng, direction(rng.uniform(0, 360)) * rng.uniform(5, 8), rng.uniform(0, 360))
    K, size = scaled_camera(FOCAL, SIZE, scale)
    arc = min(360.0, 20.0 * shots)
    start = rng.uniform(0, 360)
    azimuth = start + arc * (np.arange(shots) + rng.uniform(-0.3, 0.3, shots)) / shots
    taken = []
    for a in azimuth:
        radius = rng.uniform(9.5, 16.5)
        eye = direction(a) * radius + vec(0, 0, rng.uniform(1.3, 2.6))
        at = vec(*rng.normal(0, 0.7, 2), 0.42 * height + rng.normal(0, 0.3))
        camera = look_at(K, size, eye.tolist(), at.tolist(), roll=float(rng.normal(0, 0.03)))
        taken.append(Shot(camera, Lens(exposure=float(rng.uniform(0.8, 1.2)), noise=3.0, blur=0.7), jpeg=88))
    light = Light(sun(rng.uniform(0, 360), rng.uniform(30, 65)))
    apart = np.abs((azimuth[:, None] - azimuth[None] + 180) % 360 - 180)
    # Wide before narrow within each round, so that the pairs kept spread evenly over the angles.
    width, rounds, order = (ANGLES[1] - ANGLES[0]) / 4, Counter[int](), []
    for pair in shuffled_pairs(rng, shots, lambda i, j: bool(ANGLES[0] <= apart[i, j] <= ANGLES[1])):
        step = int((apart[pair] - ANGLES[0]) / width)
        rounds[step] += 1
        order.append((rounds[step], -step, pair))
    sky = heaven(rng, rng.uniform(-0.4, 0.6))
    return DrawnScene([surfaces], [light], sky, taken, [pair for _, _, pair in sorted(order)])


# The collection family, after CPC: a landmark photographed by many people; other cameras, zooms, light and weather

SIZES = ((600, 800), (533, 800), (450, 800), (576, 768), (683, 1024), (480, 640))
LIGHTS = 4  # times of day


def _gable(surfaces: Surfaces, x: Real, y: Real, z: Real, width: Real, height: Real, deep: Real, stone: int) -> None:
    left, right, top = vec(x, y, z), vec(x + width, y, z), vec(x + width / 2, y, z + height)
    uv = np.array([[0.0, 1.0], [1.0, 0.0], [0.5, -1.0]]) * np.array([3.0, 1.0])
    surfaces.piece(left, right - left, top - left, stone, uv, triangle=True, both_sides=True)
    back = vec(0, deep, 0)
    surfaces.quad(top + back, left - top, -back, stone, (0, 0, 2, 2), both_sides=True)
    surfaces.quad(top, right - top, back, stone, (0, 0, 2, 2), both_sides=True)


def _landmark(surfaces: Surfaces, rng: Rng, split: str) -> float:
    """A long front with many equal windows, a portico, perhaps towers; returns its width."""
    width, height = rng.uniform(24, 36), rng.uniform(9, 13)
    stone, block = buildings.marble(surfaces, rng), buildings.ashlar(surfaces, rng)
    style = Style(
        density=52, storey=rng.uniform(3.2, 4.4), bay=rng.uniform(2.6, 3.4), depth=0.4, pilasters=rng.random() < 0.5,
        same_windows=0.85,
    )  # fmt: skip
    buildings.front(surfaces, rng, split, vec(-width / 2, 0, 0), vec(1, 0, 0), width, height, style)
    end = vec(0, 14, 0)
    for x, along in ((-width / 2, -1), (width / 2, 1)):
        foot = vec(x, 0, 0) + (end if along < 0 else 0)
        buildings.front(surfaces, rng, split, foot, vec(0, along, 0), 14, height, Style(density=36, depth=0.3))
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
        buildings.column(surfaces, vec(float(x), -out + 0.5, 0.64), tall - 0.64, 0.42, stone)
    banner = surfaces.paint(sign(rng, 96, 1024))
    surfaces.box(
        vec(-portico / 2, -out, tall), vec(portico, 0, 0), vec(0, out, 0), 1.0, [banner, block, block, block, stone],
        ((0, 0, 1, 1), (0, 0, 0.4, 0.2), (0, 0, 1, 0.2), (0, 0, 0.4, 0.2), (0, 0, 1, 1)),
    )  # fmt: skip
    _gable(surfaces, -portico / 2 - 0.3, -out - 0.1, tall + 1.0, portico + 0.6, rng.uniform(1.5, 2.6), out, block)
    if rng.random() < 0.6:
        for x in (-width / 2 - 1.0, width / 2 - 4.0):
            buildings.house(surfaces, rng, split, vec(x, -1.2, 0), vec(1, 0, 0), (5.0, 5.0, height + rng.uniform(3, 6)),
                  Style(density=52, storey=4.0, bay=2.5, depth=0.35))  # fmt: skip
    for x in np.linspace(-width / 2 + 2, width / 2 - 2, 6):
        if abs(x) > portico / 2 + 1.5:
            foot, window = vec(x - 0.7, -3.6, 0), (0, 0, 0.25, 0.4)
            surfaces.box(foot, vec(1.4, 0, 0), vec(0, 1.4, 0), 1.6, [block] * 5, (window,) * 5)
            buildings.statue(surfaces, rng, vec(x, -2.9, 1.6), 2.6, stone, detail=12)
    for picture in pictures(split, rng, 2):
        x, wide = rng.uniform(-width / 2 + 1, width / 2 - 4), 2.4
        high = wide * picture.shape[0] / picture.shape[1]
        surfaces.quad(vec(x, -0.5, 1.4 + high), vec(wide, 0, 0), vec(0, 0, -high), surfaces.texture(picture))
    return width


def collection_scene(rng: Rng, split: str, shots: int, scale: Real) -> DrawnScene:
    """A landmark with `shots` photographs by as many people; images are scaled by `scale`."""
    fixed = Surfaces()
    width = _landmark(fixed, rng, split)
    _surroundings(fixed, rng, split, width)
    lights, surfaces = _times_of_day(fixed, rng, width)
    taken = [_photograph(rng, width, scale, light=i % LIGHTS) for i in range(shots)]
    return DrawnScene(surfaces, lights, heaven(rng, rng.uniform(-0.3, 0.7)), taken, shuffled_pairs(rng, shots))


def _surroundings(surfaces: Surfaces, rng: Rng, split: str, width: Real) -> None:
    ground(surfaces, rng, split, 36)
    leaf, bark = buildings.foliage(surfaces, rng)
    for side in (-1, 1):
        foot, size = vec(side * (width / 2 + 3) - (12 if side < 0 else 0), 4, 0), (12, 8, rng.uniform(7, 11))
        style = Style(density=30, same_windows=0.8)
        buildings.house(surfaces, rng, split, foot, vec(1, 0, 0), size, style, sides="plain")
        for _ in range(3):
            at = vec(side * rng.uniform(width / 2 - 3, width / 2 + 8), -rng.uniform(2, 10), 0)
            buildings.tree(surfaces, rng, at, rng.uniform(4, 7), leaf, bark)
    metal = surfaces.texture(np.full((16, 16, 3), 70, dtype=np.uint8))
    for x in np.linspace(-width / 2, width / 2, 4):
        buildings.post(surfaces, vec(x, -8, 0), 4.5, metal)


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
            buildings.walker(crowd, rng, vec(rng.normal(0, width / 3), -rng.uniform(3, 22), 0), rng.uniform(225, 315))
        surfaces.append(crowd)
    return lights, surfaces


def _photograph(rng: Rng, width: Real, scale: Real, light: int) -> Shot:
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
