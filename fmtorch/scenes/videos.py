"""The families of videos: driving along a street after KITTI, and hand-held video of a room after TUM RGB-D."""

import cv2
import numpy as np

from fmtorch.scenes import patterns
from fmtorch.scenes.buildings import Style, car, direction, foliage, front, post, statue, tree, walker
from fmtorch.scenes.light import DrawnScene, Lens, Light, Shot, shuffled_pairs, sun
from fmtorch.scenes.patterns import Rng, colour
from fmtorch.scenes.raycast import Camera, look_at, scaled_camera
from fmtorch.scenes.surfaces import Real, Surfaces, Vector, pictures, to_pixels, vec

DRIVING_SIZE = (376, 1241)
DRIVING_FOCAL, DRIVING_CENTRE = 718.856, (607.19, 185.22)  # KITTI odometry, sequence 00
HEIGHT = 1.65  # of the camera, metres
SPACING = 0.9  # between frames, metres (10 Hz at 32 km/h)
STRETCH = 18.0  # metres of road that one picture shows
DRIVING_WINDOW = 10  # a frame is paired with the frames of the following second


def _road(surfaces: Surfaces, rng: Rng, length: float, half: float, walk: float) -> None:
    """Asphalt with markings, pavements with kerbs, a meadow around."""
    road = patterns.asphalt(rng, 512, 1024)
    for x in range(64, 1024, 341):
        cv2.rectangle(road, (x, 250), (x + 150, 261), (0.82, 0.82, 0.78), -1)
    for y in (16, 490):
        cv2.line(road, (0, y), (1024, y), (0.75, 0.75, 0.7), 6)
    worn = (0.65 * road + 0.3 * patterns.asphalt(rng, 512, 1024)).astype(np.float32)
    asphalts = [surfaces.paint(road), surfaces.paint(worn)]
    tint = colour(rng, (0.05, 0.12), (0.02, 0.15), (0.45, 0.7))
    tiles = patterns.masonry(rng, 256, 512, 6, 10, tint, joint=0.04, vary=0.08)
    cobbles = patterns.cells(rng, 256, 512, 20, patterns.rgb(0.5, 0.48, 0.46))
    stones = surfaces.paint(tiles if rng.random() < 0.6 else cobbles)
    green = surfaces.paint(patterns.meadow(rng, 512, 512, colour(rng, (0.2, 0.3), (0.4, 0.6), (0.35, 0.5))))
    for i in range(-1, int(np.ceil(length / STRETCH)) + 6):
        along, start = vec(STRETCH, 0, 0), i * STRETCH
        surfaces.quad(vec(start, half, 0), along, vec(0, -2 * half, 0), asphalts[int(rng.integers(2))])
        for edge in (half + walk, -half):
            surfaces.quad(vec(start, edge, 0.12), along, vec(0, -walk, 0), stones, (0, 0, 3, 1))
        for edge in (half, -half):
            surfaces.quad(vec(start, edge, 0.12), along, vec(0, 0, -0.12), stones, (0, 0, 1, 0.1), both_sides=True)
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
    leaf, bark = foliage(surfaces, rng)
    metal = surfaces.paint(np.full((32, 32, 3), 0.35, dtype=np.float32))
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


def driving_scene(rng: Rng, split: str, shots: int, scale: Real) -> DrawnScene:
    """A street of `shots` frames; images are scaled by `scale`."""
    surfaces = Surfaces()
    frames = np.concatenate([[0], np.cumsum(rng.integers(1, 5, shots - 1))])
    length = 30.0 + float(frames[-1]) * SPACING
    half, walk, gap = rng.uniform(3.4, 4.6), rng.uniform(1.8, 3.0), rng.uniform(0.2, 0.6)
    _road(surfaces, rng, length, half, walk)
    for side in (1, -1):
        _row_of_houses(surfaces, rng, split, length, half + walk + rng.uniform(0, 3), side, gap)
        _roadside(surfaces, rng, length, half, side)
    K, size = scaled_camera(DRIVING_FOCAL, DRIVING_SIZE, scale, DRIVING_CENTRE)
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
    sky = patterns.heaven(rng, rng.uniform(-0.3, 0.8))
    pairs = shuffled_pairs(rng, shots, lambda i, j: bool(frames[j] - frames[i] <= DRIVING_WINDOW))
    return DrawnScene(views, [light] * shots, sky, taken, pairs)


# The indoor family, after TUM RGB-D: hand-held video of a room; short baselines, bare walls, motion blur, noise

SIZE = (480, 640)
FOCAL = 525.0  # the depth sensor's colour camera
RATE = 30.0  # frames a second
EXPOSURE = 0.02  # seconds
WINDOW = 1.0  # a frame is paired with the frames of the following second
SUBFRAMES = 6


def _flat(surfaces: Surfaces, rng: Rng, tint: tuple[Real, Real] = (0.05, 0.15)) -> int:
    return surfaces.paint(patterns.plaster(rng, 256, 256, colour(rng, tint, (0.05, 0.4), (0.3, 0.85)), 0.6))


def _room(surfaces: Surfaces, rng: Rng, half: Real, height: Real) -> None:
    tint = colour(rng, (0.08, 0.65), (0.02, 0.15), (0.7, 0.9))
    if rng.random() < 0.6:
        floor = patterns.wood(rng, 1024, 1024, 22, colour(rng, (0.05, 0.1), (0.35, 0.6), (0.4, 0.65)))
    else:
        stone = colour(rng, (0.05, 0.6), (0.03, 0.2), (0.5, 0.8))
        floor = patterns.masonry(rng, 1024, 1024, 14, 14, stone, bond=0.0, vary=0.04)
    number = surfaces.paint(floor)
    surfaces.quad(vec(-half, half, 0), vec(2 * half, 0, 0), vec(0, -2 * half, 0), number)
    ceiling = surfaces.paint(patterns.plaster(rng, 256, 256, patterns.rgb(0.85, 0.85, 0.83), 0.3))
    surfaces.quad(vec(-half, -half, height), vec(2 * half, 0, 0), vec(0, 2 * half, 0), ceiling)
    for k in range(4):
        inward, right = -direction(90 * k), direction(90 * k - 90)
        wall = patterns.plaster(rng, 512, 1024, tint, 0.5)
        wall[478:] = tint * 0.6
        number = surfaces.paint(wall)
        surfaces.quad(-inward * half - right * half + vec(0, 0, height), right * 2 * half, vec(0, 0, -height), number)


def _on_wall(surfaces: Surfaces, picture: np.ndarray, k: int, half: Real, x: Real, z: Real, wide: Real) -> None:
    """A framed picture on wall k, its middle at (x, z), a little off the wall."""
    inward, right = -direction(90 * k), direction(90 * k - 90)
    tall = wide * picture.shape[0] / picture.shape[1]
    frame = surfaces.texture(np.full((8, 8, 3), 60, dtype=np.uint8))
    top = -inward * (half - 0.03) + right * (x - wide / 2) + vec(0, 0, z + tall / 2)
    surfaces.quad(top, right * wide, vec(0, 0, -tall), surfaces.texture(picture))
    surfaces.quad(top, right * wide, -inward * 0.03, frame, both_sides=True)
    surfaces.quad(top, -inward * 0.03, vec(0, 0, -tall), frame, both_sides=True)


def _desk(surfaces: Surfaces, rng: Rng, split: str, centre: Vector) -> None:
    top = surfaces.paint(patterns.wood(rng, 256, 512, 4, colour(rng, (0.05, 0.1), (0.3, 0.6), (0.4, 0.7))))
    facing = rng.uniform(-25, 25)
    right, back = direction(facing), direction(facing + 90)
    wide, deep, tall = 1.7, 0.85, 0.74
    corner = centre - right * wide / 2 - back * deep / 2
    strip = ((0.0, 0.0, 1.0, 0.06),) * 4 + ((0.0, 0.0, 1.0, 1.0),)
    surfaces.box(corner + vec(0, 0, tall - 0.05), right * wide, back * deep, 0.05, [top] * 5, strip)
    for x in (0.05, wide - 0.11):
        for y in (0.05, deep - 0.11):
            surfaces.box(corner + right * x + back * y, right * 0.06, back * 0.06, tall - 0.05, [top] * 5, strip)
    taken: list[tuple[Real, Real]] = []
    photos = pictures(split, rng, 3)
    for k in range(14):
        x, y = rng.uniform(0.15, wide - 0.35), rng.uniform(0.12, deep - 0.3)
        if any(np.hypot(x - a, y - b) < 0.19 for a, b in taken):
            continue
        taken.append((x, y))
        base = corner + right * x + back * y + vec(0, 0, tall)
        turned = facing + rng.uniform(-40, 40)
        r, b = direction(turned), direction(turned + 90)
        if k == 0:
            screen = surfaces.texture(photos[0])
            case = surfaces.texture(np.full((8, 8, 3), 25, dtype=np.uint8))
            surfaces.box(base + vec(0, 0, 0.08), r * 0.46, b * 0.04, 0.29, [screen, case, case, case, case])
            surfaces.box(base + r * 0.18, r * 0.1, b * 0.04, 0.08, [case] * 5)
        elif k == 1:
            tint = colour(rng, (0.04, 0.1), (0.4, 0.7), (0.4, 0.7))
            fur = tint * (1 + 0.3 * patterns.fractal(rng, 256, 256, 16, 1, 0.8))[..., None]
            statue(surfaces, rng, base, 0.42, surfaces.paint(fur.astype(np.float32)), detail=12)
        elif k < 5:
            number = surfaces.paint(patterns.books(rng, 160, 256))
            plain = _flat(surfaces, rng, (0, 1))
            surfaces.box(base, r * rng.uniform(0.2, 0.34), b * 0.17, 0.23, [number, plain, plain, plain, plain])
        else:
            label = surfaces.texture(photos[k % 3] if rng.random() < 0.3 else to_pixels(patterns.poster(rng, 160, 160)))
            plain = _flat(surfaces, rng, (0, 1))
            surfaces.box(base, r * rng.uniform(0.08, 0.2), b * rng.uniform(0.08, 0.2), rng.uniform(0.06, 0.25),
                         [label, plain, label, plain, plain])  # fmt: skip


def _cabinet(surfaces: Surfaces, rng: Rng, base: Vector, degrees: Real) -> None:
    right, back = direction(degrees), direction(degrees + 90)
    front = patterns.door(rng, 512, 300)
    sides = surfaces.paint(front * 0 + patterns.plaster(rng, 512, 300, front[4, 4], 0.7))
    surfaces.box(base, right * 0.9, back * 0.45, 1.3, [surfaces.paint(front), sides, sides, sides, sides])
    shelf = surfaces.paint(patterns.books(rng, 192, 512))
    foot = base + right * 0.05 + vec(0, 0, 1.3)
    surfaces.box(foot, right * 0.8, back * 0.2, 0.26, [shelf, sides, sides, sides, sides])


def _path(rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Amplitudes and phases of a hand's smooth movement: three sinusoids for each of six coordinates."""
    speed = rng.uniform(0.6, 1.5)
    frequency = np.array([0.11, 0.37, 1.3])[:, None] * rng.uniform(0.8, 1.2, (3, 6))
    size = speed * np.array([0.50, 0.10, 0.010])[:, None] * np.array([1, 1, 0.35, 0.5, 0.5, 0.35])
    return size * rng.uniform(0.6, 1.2, (3, 6)), np.stack([frequency, rng.uniform(0, 2 * np.pi, (3, 6))])


def indoor_scene(rng: Rng, split: str, shots: int, scale: Real) -> DrawnScene:
    """A room and a video of it; `shots` frames in groups that lie within a second; images are scaled by `scale`."""
    surfaces = Surfaces()
    half, height = rng.uniform(2.3, 3.0), 2.7
    _room(surfaces, rng, half, height)
    desk = vec(rng.uniform(-0.4, 0.4), half - rng.uniform(0.6, 1.0), 0)
    _desk(surfaces, rng, split, desk)
    photos = pictures(split, rng, 2) + [to_pixels(patterns.poster(rng, 360, 270)) for _ in range(3)]
    _on_wall(surfaces, photos[0], 1, half, rng.uniform(0.9, 1.4), 1.55, 0.6)
    if rng.random() < 0.8:
        _on_wall(surfaces, photos[2], 1, half, rng.uniform(-1.4, -0.9), 1.5, 0.5)
    _on_wall(surfaces, photos[1], 0, half, rng.uniform(-1, 0.5), 1.5, 0.7)
    _on_wall(surfaces, photos[3], 2, half, rng.uniform(-0.5, 1), 1.5, 0.6)
    view = to_pixels(patterns.window(rng, 512, 420, np.random.SeedSequence(int(rng.integers(2**31)))) * 2.2 + 0.1)
    _on_wall(surfaces, view, 2 * int(rng.integers(2)), half, -1.2, 1.6, 1.1)
    shelf = surfaces.paint(patterns.books(rng, 192, 768))
    board = _flat(surfaces, rng)
    x = rng.uniform(-0.6, 0.4)
    for z in (1.25, 1.62)[: int(rng.integers(1, 3))]:
        surfaces.box(vec(x, half - 0.25, z), vec(1.1, 0, 0), vec(0, 0.25, 0), 0.03, [board] * 5)
        surfaces.box(vec(x + 0.05, half - 0.2, z + 0.03), vec(0.9, 0, 0), vec(0, 0.2, 0), 0.22,
                     [shelf, board, board, board, board])  # fmt: skip
    _cabinet(surfaces, rng, vec(half - 1.2, half - 0.55, 0), rng.uniform(-6, 6))
    rug = surfaces.paint(patterns.cloth(rng, 384, 512))
    surfaces.quad(vec(-1.1, half - 1.3, 0.01), vec(2.2, 0, 0), vec(0, -1.6, 0), rug)
    K, size = scaled_camera(FOCAL, SIZE, scale)
    amplitude, (frequency, phase) = _path(rng)
    stand = desk + vec(rng.uniform(-0.6, 0.6), -rng.uniform(1.2, 1.9), rng.uniform(1.2, 1.5))
    aim = desk + vec(0, 0.2, rng.uniform(0.85, 1.1))

    def camera(time: Real) -> Camera:
        move = (amplitude * np.sin(2 * np.pi * frequency * time + phase)).sum(0)
        return look_at(K, size, (stand + move[:3]).tolist(), (aim + move[3:]).tolist(), roll=float(0.15 * move[0]))

    group = 6  # frames that lie within one second
    times = np.concatenate([
        np.sort(rng.choice(np.arange(1, int(WINDOW * RATE)), group - 1, replace=False)) / RATE + start
        for start in 7.0 * np.arange(-(-shots // (group - 1)))
    ])[:shots]  # fmt: skip
    taken = []
    for t in times:
        moments = [camera(float(t + EXPOSURE * (k / (SUBFRAMES - 1) - 0.5))) for k in range(SUBFRAMES)]
        taken.append(Shot(camera(float(t)), Lens(blur=0.6, noise=4.0, exposure=1.15), moments=moments, jpeg=95))
    up, direct = rng.uniform(0.7, 1.0), rng.uniform(0.25, 0.5)
    light = Light(
        (rng.uniform(-0.5, 0.5), rng.uniform(-0.8, -0.3), 1.0), sun=(direct, 0.95 * direct, 0.85 * direct),
        sky=(up, 0.97 * up, 0.92 * up), ground_shade=0.2, through_walls=True,
    )  # fmt: skip
    sky = np.full((8, 16, 3), 128, dtype=np.uint8)
    pairs = shuffled_pairs(rng, shots, lambda i, j: bool(0 < times[j] - times[i] <= WINDOW))
    return DrawnScene([surfaces], [light], sky, taken, pairs)
