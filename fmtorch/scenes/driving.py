"""The driving family, after KITTI: forward motion along a street, grey, wide and low images, repeated markings."""

from __future__ import annotations

import cv2
import numpy as np

from fmtorch.scenes.buildings import Style, car, direction, foliage, front, post, tree, walker
from fmtorch.scenes.camera import calibration, look_at
from fmtorch.scenes.light import Lens, Light, sun
from fmtorch.scenes.patterns import Rng, asphalt, cells, colour, heaven, masonry, meadow, rgb, to_pixels
from fmtorch.scenes.scene import Scene, Shot
from fmtorch.scenes.surfaces import Surfaces, vec
from fmtorch.scenes.textures import Real

SIZE = (376, 1241)
FOCAL, CENTRE = 718.856, (607.19, 185.22)  # KITTI odometry, sequence 00
HEIGHT = 1.65  # of the camera, metres
SPACING = 0.9  # between frames, metres (10 Hz at 32 km/h)
STRETCH = 18.0  # metres of road that one picture shows
WINDOW = 10  # a frame is paired with the frames of the following second


def _road(surfaces: Surfaces, rng: Rng, length: float, half: float, walk: float) -> None:
    """Asphalt with markings, pavements with kerbs, a meadow around."""
    road = asphalt(rng, 512, 1024)
    for x in range(64, 1024, 341):
        cv2.rectangle(road, (x, 250), (x + 150, 261), (0.82, 0.82, 0.78), -1)
    for y in (16, 490):
        cv2.line(road, (0, y), (1024, y), (0.75, 0.75, 0.7), 6)
    worn = (0.65 * road + 0.3 * asphalt(rng, 512, 1024)).astype(np.float32)
    asphalts = [surfaces.texture(to_pixels(road)), surfaces.texture(to_pixels(worn))]
    tiles = masonry(rng, 256, 512, 6, 10, colour(rng, (0.05, 0.12), (0.02, 0.15), (0.45, 0.7)), joint=0.04, vary=0.08)
    cobbles = cells(rng, 256, 512, 20, rgb(0.5, 0.48, 0.46))
    stones = surfaces.texture(to_pixels(tiles if rng.random() < 0.6 else cobbles))
    green = surfaces.texture(to_pixels(meadow(rng, 512, 512, colour(rng, (0.2, 0.3), (0.4, 0.6), (0.35, 0.5)))))
    for i in range(-1, int(np.ceil(length / STRETCH)) + 6):
        along, start = vec(STRETCH, 0, 0), i * STRETCH
        surfaces.quad(vec(start, half, 0), along, vec(0, -2 * half, 0), asphalts[int(rng.integers(2))])
        for edge in (half + walk, -half):
            surfaces.quad(vec(start, edge, 0.12), along, vec(0, -walk, 0), stones, (0, 0, 3, 1))
        for edge in (half, -half):
            kerb = (0, 0, 1, 0.1)
            surfaces.quad(vec(start, edge, 0.12), along, vec(0, 0, -0.12), stones, kerb, both_sides=True)
    surfaces.quad(vec(-60, 90, -0.05), vec(length + 240, 0, 0), vec(0, -180, 0), green, (0, 0, 40, 25))


def _row_of_houses(surfaces: Surfaces, rng: Rng, split: str, length: float, wall: float, side: int, gap: float) -> None:
    """Fronts along one side of the street, `wall` metres from its middle; trees where a house is missing."""
    leaf, bark = foliage(surfaces, rng)
    x = -10.0
    while x < length + 60:
        width = rng.uniform(7, 15)
        if rng.random() < gap:
            for _ in range(2):
                at = vec(x + rng.uniform(0, width), side * (wall + rng.uniform(0, 5)), 0)
                tree(surfaces, rng, at, rng.uniform(4, 8), leaf, bark)
            x += width
            continue
        style = Style(
            density=22 if x > length - 5 else 46, storey=rng.uniform(2.8, 3.5), bay=rng.uniform(2.2, 3.4),
            depth=rng.uniform(0.12, 0.3), shop=rng.random() < 0.4, same_windows=0.75,
        )  # fmt: skip
        foot = vec(x if side > 0 else x + width, side * (wall + rng.uniform(0, 1.2)), 0)
        right, height = vec(side, 0, 0), rng.uniform(5.5, 12)
        number = front(surfaces, rng, split, foot, right, width, height, style)
        back = -6 * np.cross(right, vec(0, 0, 1))
        flank = (0, 0, 6 / width, 1)
        surfaces.quad(foot + back + vec(0, 0, height), -back, vec(0, 0, -height), number, flank)
        surfaces.quad(foot + right * width + vec(0, 0, height), back, vec(0, 0, -height), number, flank)
        x += width


def _roadside(surfaces: Surfaces, rng: Rng, length: float, half: float, side: int) -> None:
    """Parked cars, trees, lamp posts and people along one side."""
    leaf, bark = foliage(surfaces, rng)
    metal = surfaces.texture(to_pixels(np.full((32, 32, 3), 0.35, dtype=np.float32)))
    x = rng.uniform(0, 8)
    while x < length + 30:
        kind = rng.random()
        if kind < 0.45:
            car(surfaces, rng, vec(x, side * (half - 1.0), 0), vec(-side, 0, 0))
        elif kind < 0.75:
            tree(surfaces, rng, vec(x, side * (half + 0.7), 0.1), rng.uniform(3.5, 6), leaf, bark)
        elif kind < 0.9:
            post(surfaces, vec(x, side * (half + 0.4), 0.1), rng.uniform(4, 6), metal)
        else:
            walker(surfaces, rng, vec(x, side * (half + 1.1), 0.1), rng.choice([0.0, 180.0]))
        x += rng.uniform(5, 12)


def _street(surfaces: Surfaces, rng: Rng, split: str, length: float) -> None:
    half, walk, gap = rng.uniform(3.4, 4.6), rng.uniform(1.8, 3.0), rng.uniform(0.2, 0.6)
    _road(surfaces, rng, length, half, walk)
    for side in (1, -1):
        _row_of_houses(surfaces, rng, split, length, half + walk + rng.uniform(0, 3), side, gap)
        _roadside(surfaces, rng, length, half, side)


def scene(rng: Rng, split: str, shots: int, scale: Real) -> Scene:
    """A street of `shots` frames; images are scaled by `scale`."""
    surfaces = Surfaces()
    frames = np.concatenate([[0], np.cumsum(rng.integers(1, 5, shots - 1))])
    length = 30.0 + float(frames[-1]) * SPACING
    _street(surfaces, rng, split, length)
    size = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    K = calibration(FOCAL * scale, size, (CENTRE[0] * scale, CENTRE[1] * scale))
    speed, bend = float(np.exp(rng.uniform(np.log(0.03), np.log(1.2)))) * SPACING, rng.normal(0, 0.6)
    drift = rng.uniform(-1.2, 0.2)
    light = Light(sun(rng.uniform(0, 360), rng.uniform(25, 60)))
    lens = Lens(grey=True, noise=rng.uniform(2.5, 5.0), blur=rng.uniform(0.6, 0.9), exposure=rng.uniform(0.7, 1.4))
    traffic = [(rng.uniform(7, 16), -1.7, rng.uniform(0.85, 1.15) * speed)] if rng.random() < 0.85 else []
    traffic += [(rng.uniform(8, 60), 1.7, -rng.uniform(0.5, 1.2)) for _ in range(int(rng.integers(1, 4)))]
    models = [int(rng.integers(2**31)) for _ in traffic]
    taken, views = [], []
    for k, i in enumerate(frames.tolist()):
        x: float = 2.0 + i * speed
        y = drift + bend * np.sin(i * speed / 14) + rng.normal(0, 0.01)
        slope = np.degrees(bend / 14 * np.cos(i * speed / 14)) + rng.normal(0, 0.4)
        eye = vec(x, y, HEIGHT + rng.normal(0, 0.015))
        at = eye + direction(slope) + vec(0, 0, -0.02 + rng.normal(0, 0.006))
        camera = look_at(K, size, eye.tolist(), at.tolist(), roll=float(rng.normal(0, 0.006)))
        taken.append(Shot(camera, lens, light=k, jpeg=97))
        view = surfaces.copy()
        for (start, lane, pace), model in zip(traffic, models, strict=True):
            foot = vec(2.0 + start + i * pace, lane, 0)
            car(view, np.random.default_rng(model), foot, vec(1.0 if lane < 0 else -1.0, 0, 0))
        views.append(view)
    sky = heaven(rng, rng.uniform(-0.3, 0.8))
    pairs = [(i, j) for i in range(shots) for j in range(i + 1, shots) if frames[j] - frames[i] <= WINDOW]
    return Scene(views, [light] * shots, sky, taken, [pairs[k] for k in rng.permutation(len(pairs))])
