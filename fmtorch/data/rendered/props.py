"""Things that stand about: trees, lamp posts, cars, people, rocks, statues, columns, shelves."""

from __future__ import annotations

import numpy as np

from fmtorch.data.rendered.drawings import car_end, car_side, person
from fmtorch.data.rendered.mipmap import Real
from fmtorch.data.rendered.patterns import Rng, colour, fractal, heights, leaves, masonry, plaster, to_pixels, wood
from fmtorch.data.rendered.surfaces import Surfaces, Vector, vec


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
    profile = [(0.0, radius * 1.3), (0.3 * height, radius), (0.75 * height, radius * 0.5)]
    surfaces.lathe(foot, profile, bark, sides=6)
    for _ in range(11):
        offset = rng.normal(0, [0.13, 0.13, 0.1]) * height
        side = height * rng.uniform(0.32, 0.5)
        at = foot + vec(0, 0, 0.48 * height) + offset
        card(surfaces, at, rng.uniform(0, 360), side, side, leaf)


def foliage(surfaces: Surfaces, rng: Rng, size: int = 256) -> tuple[int, int]:
    """Textures of leaves and bark."""
    leaf = surfaces.texture(leaves(rng, size, colour(rng, (0.18, 0.34), (0.4, 0.7), (0.35, 0.65))))
    bark = wood(rng, 128, 128, 3, colour(rng, (0.06, 0.1), (0.3, 0.5), (0.25, 0.45)))
    return leaf, surfaces.texture(to_pixels(np.ascontiguousarray(bark.transpose(1, 0, 2))))


def post(surfaces: Surfaces, foot: Vector, height: Real, texture: int) -> None:
    """A lamp post."""
    surfaces.lathe(foot, [(0, 0.12), (0.5, 0.09), (height, 0.06)], texture, sides=6, repeat=(1, 4))
    surfaces.lathe(foot + vec(0, 0, height), [(0, 0.06), (0.15, 0.25), (0.5, 0.22), (0.6, 0.05)], texture, sides=8)


def car(surfaces: Surfaces, rng: Rng, foot: Vector, ahead: Vector) -> None:
    """A car centred on `foot`: a bonnet and a cabin as boxes, painted sides that stand a little off."""
    tone = colour(rng, (0, 1), (0, 0.8), (0.15, 0.95))
    side, end = surfaces.texture(car_side(rng, tone)), surfaces.texture(to_pixels(car_end(rng, tone)))
    metal = surfaces.texture(to_pixels(plaster(rng, 64, 64, tone, 0.5)))
    left = np.cross(vec(0, 0, 1), ahead)
    length, width = rng.uniform(3.9, 4.7), rng.uniform(1.7, 1.85)
    rear = foot - ahead * (length / 2) + left * (width / 2)
    paint = [end, metal, end, metal, metal]
    body = [end, metal, end, metal, metal]
    surfaces.box(rear + vec(0, 0, 0.3), -left * width, ahead * length, 0.52, body)
    cabin = rear + ahead * (0.18 * length) - left * 0.08 + vec(0, 0, 0.82)
    surfaces.box(cabin, -left * (width - 0.16), ahead * (0.55 * length), 0.6, paint, ((0, 0, 1, 0.5),) * 5)
    for shift, along in ((0.01, -ahead), (-width - 0.01, ahead)):
        top = foot + left * (width / 2 + shift) - along * (length / 2) + vec(0, 0, 1.5)
        surfaces.quad(top, along * length, vec(0, 0, -1.52), side)


def walker(surfaces: Surfaces, rng: Rng, foot: Vector, facing: Real) -> None:
    """Somebody, as a picture that faces the camera's side."""
    card(surfaces, foot, facing, 0.66, rng.uniform(1.55, 1.9), surfaces.texture(person(rng)))


def rock(surfaces: Surfaces, rng: Rng, foot: Vector, radius: Real, texture: int, detail: int = 12) -> None:
    """A boulder: a sphere with relief."""
    angle = np.linspace(-0.35 * np.pi, 0.5 * np.pi, detail)
    profile = [(float(radius * np.sin(a)), float(radius * np.cos(a)) + 1e-4) for a in angle]
    bumps = 0.7 * (heights(rng, detail, detail + 4, 6) - 0.5)
    surfaces.lathe(foot, profile, texture, sides=detail + 4, repeat=(2, 1), bumps=bumps)


def statue(surfaces: Surfaces, rng: Rng, foot: Vector, height: Real, texture: int, detail: int = 16) -> None:
    """A figure-like turned shape with relief, on a base."""
    steps = np.linspace(0, 1, detail)
    body = 0.19 + 0.07 * np.sin(steps * 7 + rng.uniform(0, 6)) - 0.05 * steps
    body[steps > 0.78] = 0.07
    body[steps > 0.86] = 0.105
    body[-1] = 0.02
    profile = [(float(s * height), float(b * height)) for s, b in zip(steps, body, strict=True)]
    bumps = 0.55 * (heights(rng, detail, 14, 5) - 0.5)
    surfaces.lathe(foot, profile, texture, sides=14, repeat=(1, 1), bumps=bumps)


def column(surfaces: Surfaces, foot: Vector, height: Real, radius: Real, texture: int, sides: int = 10) -> None:
    """A column with a base and a capital."""
    profile = [
        (0.0, 1.35 * radius), (0.04 * height, 1.35 * radius), (0.06 * height, radius), (0.5 * height, 0.97 * radius),
        (0.9 * height, 0.86 * radius), (0.95 * height, 1.3 * radius), (height, 1.35 * radius),
    ]  # fmt: skip
    surfaces.lathe(foot, profile, texture, sides=sides, repeat=(1, 1))


def marble(surfaces: Surfaces, rng: Rng, h: int = 512, w: int = 512) -> int:
    """A weathered stone texture."""
    tint = colour(rng, (0.06, 0.14), (0.05, 0.35), (0.5, 0.85))
    out = tint * (1 + 0.16 * fractal(rng, h, w, 128, 1, 0.72) + 0.08 * fractal(rng, h, w, 8, 1, 0.9))[..., None]
    return surfaces.texture(to_pixels(out.astype(np.float32)))


def ashlar(surfaces: Surfaces, rng: Rng, rows: int = 6, cols: int = 8, h: int = 512, w: int = 1024) -> int:
    """A texture of large dressed stones."""
    tint = colour(rng, (0.05, 0.13), (0.1, 0.4), (0.5, 0.85))
    return surfaces.texture(to_pixels(masonry(rng, h, w, rows, cols, tint, joint=0.03)))
