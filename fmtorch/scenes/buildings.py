"""Things that stand about (trees, lamp posts, cars, people, rocks, statues, columns) and house fronts in relief.

A front is one painted picture; windows are set back from it, sills, cornices and signs set off."""

import dataclasses
from typing import Literal, NamedTuple

import cv2
import numpy as np

from fmtorch.scenes import patterns
from fmtorch.scenes.patterns import Rng, colour
from fmtorch.scenes.surfaces import Floats, Real, Surfaces, Vector, material, vec


def direction(degrees: Real) -> Vector:
    """The horizontal unit vector at an azimuth."""
    a = np.radians(degrees)
    return vec(np.cos(a), np.sin(a), 0)


def card(surfaces: Surfaces, foot: Vector, facing: Real, width: Real, height: Real, texture: int) -> None:
    """An upright picture that faces an azimuth, seen from both sides, centred on `foot`."""
    right = direction(facing + 90)
    top = foot - right * (width / 2) + vec(0, 0, height)
    surfaces.quad(top, right * width, vec(0, 0, -height), texture, both_sides=True)


def tree(surfaces: Surfaces, rng: Rng, foot: Vector, height: Real, leaf: int, bark: int) -> None:
    """A trunk and a crown of leafy cards."""
    radius = 0.03 * height
    surfaces.lathe(foot, [(0.0, radius * 1.3), (0.3 * height, radius), (0.75 * height, radius * 0.5)], bark, sides=6)
    for _ in range(11):
        offset = rng.normal(0, [0.13, 0.13, 0.1]) * height
        side = height * rng.uniform(0.32, 0.5)
        card(surfaces, foot + vec(0, 0, 0.48 * height) + offset, rng.uniform(0, 360), side, side, leaf)


def foliage(surfaces: Surfaces, rng: Rng) -> tuple[int, int]:
    """Textures of leaves and bark."""
    leaf = surfaces.texture(patterns.leaves(rng, 256, colour(rng, (0.18, 0.34), (0.4, 0.7), (0.35, 0.65))))
    bark = patterns.wood(rng, 128, 128, 3, colour(rng, (0.06, 0.1), (0.3, 0.5), (0.25, 0.45)))
    return leaf, surfaces.paint(np.ascontiguousarray(bark.transpose(1, 0, 2)))


def post(surfaces: Surfaces, foot: Vector, height: Real, texture: int) -> None:
    """A lamp post."""
    surfaces.lathe(foot, [(0, 0.12), (0.5, 0.09), (height, 0.06)], texture, sides=6, repeat=(1, 4))
    surfaces.lathe(foot + vec(0, 0, height), [(0, 0.06), (0.15, 0.25), (0.5, 0.22), (0.6, 0.05)], texture, sides=8)


def car(surfaces: Surfaces, rng: Rng, foot: Vector, ahead: Vector) -> None:
    """A car centred on `foot`: a bonnet and a cabin as boxes, painted sides that stand a little off."""
    tone = colour(rng, (0, 1), (0, 0.8), (0.15, 0.95))
    side, end = surfaces.texture(patterns.car_side(rng, tone)), surfaces.paint(patterns.car_end(rng, tone))
    metal = surfaces.paint(patterns.plaster(rng, 64, 64, tone, 0.5))
    left = np.cross(vec(0, 0, 1), ahead)
    length, width = rng.uniform(3.9, 4.7), rng.uniform(1.7, 1.85)
    rear = foot - ahead * (length / 2) + left * (width / 2)
    paint = [end, metal, end, metal, metal]
    surfaces.box(rear + vec(0, 0, 0.3), -left * width, ahead * length, 0.52, paint)
    cabin = rear + ahead * (0.18 * length) - left * 0.08 + vec(0, 0, 0.82)
    surfaces.box(cabin, -left * (width - 0.16), ahead * (0.55 * length), 0.6, paint, ((0, 0, 1, 0.5),) * 5)
    for shift, along in ((0.01, -ahead), (-width - 0.01, ahead)):
        top = foot + left * (width / 2 + shift) - along * (length / 2) + vec(0, 0, 1.5)
        surfaces.quad(top, along * length, vec(0, 0, -1.52), side)


def walker(surfaces: Surfaces, rng: Rng, foot: Vector, facing: Real) -> None:
    """Somebody, as a picture that faces the camera's side."""
    card(surfaces, foot, facing, 0.66, rng.uniform(1.55, 1.9), surfaces.texture(patterns.person(rng)))


def rock(surfaces: Surfaces, rng: Rng, foot: Vector, radius: Real, texture: int, detail: int = 12) -> None:
    """A boulder: a sphere with relief."""
    angle = np.linspace(-0.35 * np.pi, 0.5 * np.pi, detail)
    profile = [(float(radius * np.sin(a)), float(radius * np.cos(a)) + 1e-4) for a in angle]
    bumps = 0.7 * (patterns.heights(rng, detail, detail + 4, 6) - 0.5)
    surfaces.lathe(foot, profile, texture, sides=detail + 4, repeat=(2, 1), bumps=bumps)


def statue(surfaces: Surfaces, rng: Rng, foot: Vector, height: Real, texture: int, detail: int = 16) -> None:
    """A figure-like turned shape with relief, on a base."""
    steps = np.linspace(0, 1, detail)
    body = 0.19 + 0.07 * np.sin(steps * 7 + rng.uniform(0, 6)) - 0.05 * steps
    body[steps > 0.78] = 0.07
    body[steps > 0.86] = 0.105
    body[-1] = 0.02
    profile = [(float(s * height), float(b * height)) for s, b in zip(steps, body, strict=True)]
    bumps = 0.55 * (patterns.heights(rng, detail, 14, 5) - 0.5)
    surfaces.lathe(foot, profile, texture, sides=14, repeat=(1, 1), bumps=bumps)


def column(surfaces: Surfaces, foot: Vector, height: Real, radius: Real, texture: int, sides: int = 10) -> None:
    """A column with a base and a capital."""
    profile = [
        (0.0, 1.35 * radius), (0.04 * height, 1.35 * radius), (0.06 * height, radius), (0.5 * height, 0.97 * radius),
        (0.9 * height, 0.86 * radius), (0.95 * height, 1.3 * radius), (height, 1.35 * radius),
    ]  # fmt: skip
    surfaces.lathe(foot, profile, texture, sides=sides, repeat=(1, 1))


def marble(surfaces: Surfaces, rng: Rng) -> int:
    """A weathered stone texture."""
    h = w = 512
    tint = colour(rng, (0.06, 0.14), (0.05, 0.35), (0.5, 0.85))
    veins, grain = patterns.fractal(rng, h, w, 128, 1, 0.72), patterns.fractal(rng, h, w, 8, 1, 0.9)
    return surfaces.paint((tint * (1 + 0.16 * veins + 0.08 * grain)[..., None]).astype(np.float32))


def ashlar(surfaces: Surfaces, rng: Rng) -> int:
    """A texture of large dressed stones."""
    tint = colour(rng, (0.05, 0.13), (0.1, 0.4), (0.5, 0.85))
    return surfaces.paint(patterns.masonry(rng, 512, 1024, 6, 8, tint, joint=0.03))


@dataclasses.dataclass(frozen=True)
class Style:
    """Of a front: texels per metre, storey height and bay width in metres, relief depth, repetition of windows."""

    density: Real = 64.0
    storey: Real = 3.2
    bay: Real = 2.6
    depth: Real = 0.3
    shop: bool = False
    pilasters: bool = False
    same_windows: Real = 0.5  # chance that a window is a copy of its neighbour

    def grid(self, width: Real, height: Real) -> tuple[int, int]:
        """Bays and storeys of a front."""
        return max(1, int(width / self.bay)), max(1, int(height / self.storey))


def wall_picture(rng: Rng, split: str, h: int, w: int, density: Real) -> Floats:
    """A bare wall (h, w, 3) of plaster, brick, ashlar, or the split's photograph of stone, with stains of its own."""
    kind = rng.random()
    tint = colour(rng, (0.02, 0.14), (0.1, 0.5), (0.45, 0.9))
    metres_h, metres_w = h / density, w / density
    if kind < 0.3:
        out = patterns.plaster(rng, h, w, tint, 1.6)
    elif kind < 0.55:
        tint = colour(rng, (0.0, 0.06), (0.35, 0.65), (0.4, 0.7))
        bricks = max(4, round(metres_h / 0.14)), max(4, round(metres_w / 0.32))
        out = patterns.masonry(rng, h, w, *bricks, tint, vary=0.16)
    elif kind < 0.8:
        stones = max(3, round(metres_h / 0.45)), max(3, round(metres_w / 0.9))
        out = patterns.masonry(rng, h, w, *stones, tint, joint=0.04)
    else:
        stone = material(split, "stone")
        assert stone is not None
        side = int(density * 3.0)
        tile = cv2.resize(stone, (side, side), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        out = np.tile(tile, (h // side + 1, w // side + 1, 1))[:h, :w] * (0.5 + tint)
    stains = 1 + 0.08 * patterns.fractal(rng, h, w, 512, 8) + 0.04 * patterns.fractal(rng, h, w, 16, 1, 0.8)
    return np.ascontiguousarray(out * stains[..., None], dtype=np.float32)


Rectangle = tuple[float, float, float, float]  # left, lower, right, upper edge on a front, metres from its foot


class Relief(NamedTuple):
    """The surfaces of a front: rectangles of its picture, texture `number`, set off from its plane."""

    surfaces: Surfaces
    number: int
    foot: Vector
    right: Vector
    width: Real
    height: Real

    def panel(self, x0: Real, z0: Real, x1: Real, z1: Real, depth: Real) -> None:
        """A rectangle parallel to the wall, by so much in front of it."""
        up = vec(0, 0, 1)
        corner = self.foot + self.right * x0 + up * z1 + np.cross(self.right, up) * depth
        part = (x0 / self.width, 1 - z1 / self.height, x1 / self.width, 1 - z0 / self.height)
        self.surfaces.quad(corner, self.right * (x1 - x0), up * (z0 - z1), self.number, part)

    def block(self, x0: Real, z0: Real, x1: Real, z1: Real, depth: Real) -> None:
        """A box set off from the wall (depth > 0) or a niche set back into it (depth < 0), with four sides."""
        self.panel(x0, z0, x1, z1, depth)
        right, quad, number, up = self.right, self.surfaces.quad, self.number, vec(0, 0, 1)
        out = np.cross(right, up)
        near, reach = self.foot + out * depth, -out * depth
        u0, u1, v0, v1 = x0 / self.width, x1 / self.width, 1 - z1 / self.height, 1 - z0 / self.height
        thin = abs(depth) / self.width
        upper_left, upper_right, lower_left = (near + right * x + up * z for x, z in ((x0, z1), (x1, z1), (x0, z0)))
        quad(upper_right, reach, up * (z0 - z1), number, (u1, v0, u1 + thin, v1))
        quad(upper_left + reach, -reach, up * (z0 - z1), number, (u0 - thin, v0, u0, v1))
        quad(upper_left + reach, right * (x1 - x0), -reach, number, (u0, v0 - thin, u1, v0))
        quad(lower_left, right * (x1 - x0), reach, number, (u0, v1, u1, v1 + thin))


def front(
    surfaces: Surfaces, rng: Rng, split: str, foot: Vector, right: Vector, width: Real, height: Real, style: Style
) -> int:
    """Builds a front that stands on `foot` (its lower left corner) and returns its texture's number.
    right: horizontal unit vector towards the viewer's right; the front faces right x up, away from the wall."""
    picture = wall_picture(rng, split, int(height * style.density), int(width * style.density), style.density)
    openings, boards = _paint_openings(picture, rng, width, height, style)
    relief = Relief(surfaces, surfaces.paint(picture), foot, right, width, height)
    _set_back(relief, openings, style)
    for board in boards:
        relief.block(*board, 0.12)
    _set_off(relief, style)
    return relief.number


def _paint_openings(
    picture: Floats, rng: Rng, width: Real, height: Real, style: Style
) -> tuple[list[list[Rectangle]], list[Rectangle]]:
    """Paints windows, doors and signs on the picture of a wall; where they are: openings by storey, and signs."""
    d, (bays, storeys) = style.density, style.grid(width, height)
    step_x, step_z = width / bays, height / storeys
    seed = int(rng.integers(2**31))
    win_w, win_h = step_x * rng.uniform(0.36, 0.55), step_z * rng.uniform(0.45, 0.62)
    glass = patterns.window(rng, int(win_h * d), int(win_w * d), np.random.SeedSequence(seed))
    entrance = int(rng.integers(bays))
    openings, boards = list[list[Rectangle]](), list[Rectangle]()
    for row in range(storeys):
        low = row * step_z + (0.25 * step_z if row else 0.05)
        high = low + win_h if row else low + 0.72 * step_z
        line = []
        for bay in range(bays):
            x0 = bay * step_x + (step_x - win_w) / 2
            size = (max(8, int((high - low) * d)), max(8, int(win_w * d)))
            if row == 0 and bay == entrance:
                part = patterns.door(rng, *size)
            elif row == 0 and style.shop:
                part = patterns.window(rng, *size, np.random.SeedSequence(seed + bay))
            elif rng.random() < style.same_windows:
                part = cv2.resize(glass, size[::-1]).astype(np.float32)
            else:
                part = glass = patterns.window(rng, *size, np.random.SeedSequence(seed))
            _paste(picture, part, x0, low, d)
            line.append((x0, low, x0 + win_w, high))
            if row == 0 and style.shop and rng.random() < 0.6:
                board = (bay * step_x + 0.1 * step_x, high + 0.05, bay * step_x + 0.9 * step_x, high + 0.22 * step_z)
                letters = patterns.sign(rng, int((board[3] - board[1]) * d), int((board[2] - board[0]) * d))
                _paste(picture, letters, board[0], board[1], d)
                boards.append(board)
        openings.append(line)
    return openings, boards


def _paste(picture: Floats, part: Floats, x: Real, z: Real, density: Real) -> None:
    h, w = part.shape[:2]
    y0, x0 = len(picture) - int(z * density) - h, int(x * density)
    y1 = max(y0, 0)
    place = picture[y1 : y0 + h, x0 : x0 + w]
    place[:] = part[y1 - y0 :][: place.shape[0], : place.shape[1]]


def _set_back(relief: Relief, openings: list[list[Rectangle]], style: Style) -> None:
    """The wall, with its openings set back into it, and a sill below each above the ground floor."""
    floor = 0.0
    for line in openings:
        low, high = line[0][1], line[0][3]
        relief.panel(0, floor, relief.width, low, 0)
        edges = [0.0, *[x for opening in line for x in (opening[0], opening[2])], relief.width]
        for x0, x1 in zip(edges[::2], edges[1::2], strict=True):
            relief.panel(x0, low, x1, high, 0)
        for x0, z0, x1, z1 in line:
            relief.block(x0, z0, x1, z1, -style.depth)
            if floor > 0:
                relief.block(x0 - 0.1, z0 - 0.14, x1 + 0.1, z0, 0.45 * style.depth)
        floor = high
    relief.panel(0, floor, relief.width, relief.height, 0)


def _set_off(relief: Relief, style: Style) -> None:
    """Cornices between storeys and at the top, and pilasters between bays."""
    width, height = relief.width, relief.height
    bays, storeys = style.grid(width, height)
    step_x, step_z = width / bays, height / storeys
    for row in range(1, storeys):
        relief.block(0, row * step_z - 0.1, width, row * step_z + 0.1, 0.5 * style.depth)
    relief.block(0, height - 0.45, width, height, 1.2 * style.depth)
    if style.pilasters:
        for bay in range(bays + 1):
            x = min(max(bay * step_x, 0.2), width - 0.2)
            relief.block(x - 0.2, 0, x + 0.2, height - 0.45, 0.8 * style.depth)


def house(
    surfaces: Surfaces, rng: Rng, split: str, foot: Vector, right: Vector, size: tuple[Real, Real, Real],
    style: Style, sides: Literal["own", "twin", "same", "plain"] = "own",
) -> None:  # fmt: skip
    """A house: `foot` its front left corner, `size` its width, depth and height.
    sides: each with a front of its `own`; opposite ones as `twin`s, or all four the `same`, so that they are easily
    confused; or the last three flat and `plain`, for a house far away."""
    width, depth, height = size
    back = -np.cross(right, vec(0, 0, 1))
    corners = [foot, foot + right * width, foot + right * width + back * depth, foot + back * depth]
    top = vec(0, 0, height)
    twins = np.random.SeedSequence(int(rng.integers(2**31))).spawn(2)
    number = -1
    edges = zip(corners, (right, back, -right, -back), (width, depth, width, depth), strict=True)
    for i, (corner, along, length) in enumerate(edges):
        if sides == "plain" and i > 0:
            surfaces.quad(corner + top, along * length, -top, number, (0, 0, length / width, 1))
        else:
            own = rng if sides == "own" else np.random.default_rng(twins[i % 2 if sides == "twin" else 0])
            number = front(surfaces, own, split, corner, along, length, height, style)
    surfaces.quad(corners[3] + top, right * width, -back * depth, number, (0, 0, 1, 0.1))
