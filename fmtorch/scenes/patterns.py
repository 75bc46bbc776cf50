"""Procedural pictures, float32 RGB in [0, 1], sRGB: materials (masonry, wood, ground, leaves, sky), and painted things.

Painted are windows, doors, signs, posters, books, cars and people."""

import colorsys
import string

import cv2
import numpy as np

from fmtorch.scenes.surfaces import Floats, Pixels, Real, Vector, to_pixels

Rng = np.random.Generator
_BORDER = 2  # points of a grid of noise beyond each side


def rgb(red: Real, green: Real, blue: Real) -> Floats:
    """A colour (3,)."""
    return np.array([red, green, blue], dtype=np.float32)


def colour(rng: Rng, hue: tuple[Real, Real], saturation: tuple[Real, Real], value: tuple[Real, Real]) -> Floats:
    """A random colour (3,) within ranges of hue, saturation and value."""
    return rgb(*colorsys.hsv_to_rgb(rng.uniform(*hue) % 1.0, rng.uniform(*saturation), rng.uniform(*value)))


def fractal(rng: Rng, h: int, w: int, coarsest: int = 256, finest: int = 1, roughness: Real = 0.6) -> Floats:
    """Noise (h, w) summed over octaves of `coarsest` to `finest` pixels, zero mean, unit deviation, repeating."""
    total = np.zeros((h, w), dtype=np.float32)
    weight, step = 1.0, min(coarsest, h, w)
    while step >= finest:
        rows, cols = max(1, round(h / step)), max(1, round(w / step))
        grid = rng.standard_normal((rows, cols), dtype=np.float32)
        if step > 1:
            grid = np.pad(grid, _BORDER, mode="wrap" if min(rows, cols) > 1 else "edge")
            grid = _enlarged(grid, h, w)
        total += np.float32(weight) * grid
        weight *= roughness
        step //= 2
    total -= total.mean()
    return total / max(float(total.std()), 1e-6)


def _enlarged(grid: Floats, h: int, w: int) -> Floats:
    """The grid by cubic interpolation, so that its part within the borders has h x w pixels; that part."""
    (tall, y), (wide, x) = (
        (round(side / (points - 2 * _BORDER) * points), round(_BORDER * side / (points - 2 * _BORDER)))
        for side, points in zip((h, w), grid.shape, strict=True)
    )
    big = cv2.resize(grid, (wide, tall), interpolation=cv2.INTER_CUBIC)
    part = big[y : y + h, x : x + w].astype(np.float32)
    return part if part.shape == (h, w) else cv2.resize(part, (w, h)).astype(np.float32)


def plaster(rng: Rng, h: int, w: int, tint: Floats, strength: Real = 1.0) -> Floats:
    """A painted wall: fine grain, soft stains, a few cracks."""
    shade = 1 + strength * (0.03 * fractal(rng, h, w, 512, 16) + 0.03 * fractal(rng, h, w, 8, 1, 0.8))
    out = tint * shade[..., None]
    for _ in range(int(6 * strength)):
        steps = np.cumsum(rng.normal(0, 6, (14, 2)) + rng.normal(0, 6, 2), axis=0)
        line = (rng.uniform(0, [w, h]) + steps).astype(np.int32)
        cv2.polylines(out, [line], False, (tint * 0.6).tolist(), 1, cv2.LINE_AA)
    return out.astype(np.float32)


def masonry(
    rng: Rng, h: int, w: int, rows: int, cols: int, tint: Floats, *, joint: Real = 0.06, vary: Real = 0.1,
    bond: Real = 0.5,
) -> Floats:  # fmt: skip
    """Courses of stones or bricks, each of its own colour, with mortar; `bond` shifts every second course."""
    y, x = np.mgrid[:h, :w].astype(np.float32)
    r = y * (rows / h)
    row = np.floor(r).astype(np.int32)
    c = x * (cols / w) + np.where(row % 2 == 1, np.float32(bond), np.float32(0))
    col = np.floor(c).astype(np.int32) % cols
    tones = 1 + vary * rng.standard_normal((rows, cols)).astype(np.float32)
    hues = 1 + 0.25 * vary * rng.standard_normal((rows, cols, 3)).astype(np.float32)
    flat = row % rows * cols + col
    out = tint * np.take(tones.ravel(), flat)[..., None] * np.take(hues.reshape(-1, 3), flat, axis=0)
    out *= (1 + 0.07 * fractal(rng, h, w, 32, 1, 0.8))[..., None]
    aspect = (w / cols) / (h / rows)
    edge_y = np.minimum(r - np.floor(r), 1 - (r - np.floor(r)))
    edge_x = np.minimum(c - np.floor(c), 1 - (c - np.floor(c))) * np.float32(aspect)
    wobble = np.float32(joint) * (1 + 0.35 * fractal(rng, h, w, 16, 2))
    gap = np.clip((wobble - np.minimum(edge_x, edge_y)) / np.float32(joint * 0.4) + 0.5, 0, 1)[..., None]
    mortar = (0.55 * tint + 0.15) * (1 + 0.1 * fractal(rng, h, w, 8, 1))[..., None]
    return np.asarray(out * (1 - gap) + mortar * gap, dtype=np.float32)


def cells(rng: Rng, h: int, w: int, size: int, tint: Floats) -> Floats:
    """Irregular stones (Voronoi cells of a jittered grid): cobbles, rubble."""
    vary, joint = 0.12, 2.0
    seeds = np.full((h, w), 255, dtype=np.uint8)
    gy, gx = np.mgrid[size // 2 : h : size, size // 2 : w : size]
    jitter = rng.integers(-size // 3, size // 3 + 1, (2, *gy.shape))
    seeds[np.clip(gy + jitter[0], 0, h - 1), np.clip(gx + jitter[1], 0, w - 1)] = 0
    distance, labels = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    label = labels.astype(np.int32)
    tones = 1 + vary * rng.standard_normal((int(label.max()) + 1, 1)).astype(np.float32)
    tones = tones * (1 + 0.3 * vary * rng.standard_normal((len(tones), 3)).astype(np.float32))
    border = cv2.morphologyEx(label.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    gap = cv2.GaussianBlur(border.astype(np.float32), (0, 0), joint / 2)
    out = tint * np.take(tones, label, axis=0) * (1.08 - 0.2 * distance / size)[..., None]
    out *= (1 + 0.06 * fractal(rng, h, w, 16, 1, 0.8))[..., None] * (1 - 0.75 * np.clip(gap, 0, 1))[..., None]
    return out.astype(np.float32)


def wood(rng: Rng, h: int, w: int, planks: int, tint: Floats) -> Floats:
    """Planks that run from left to right."""
    grain = cv2.resize(fractal(rng, h, max(8, w // 16), 64, 1, 0.8), (w, h), interpolation=cv2.INTER_CUBIC)
    plank = (np.arange(h) * planks // h)[:, None]
    out = tint * (1 + 0.1 * rng.standard_normal(planks))[plank][..., None] * (1 + 0.08 * grain)[..., None]
    out[np.abs(np.diff(plank[:, 0], prepend=0)) > 0] *= 0.45
    return out.astype(np.float32)


def asphalt(rng: Rng, h: int, w: int) -> Floats:
    """A road's surface: fine gravel, patches, cracks."""
    shade = 0.33 * (1 + 0.10 * fractal(rng, h, w, 256, 8) + 0.14 * fractal(rng, h, w, 4, 1, 0.9))
    out = np.repeat(shade[..., None], 3, axis=2).astype(np.float32)
    for _ in range(5):
        x, y, a, b = (*rng.uniform(0, [w, h]), *rng.uniform(20, 120, 2))
        out[int(y) : int(y + b), int(x) : int(x + a)] *= rng.uniform(0.72, 0.92)
    for _ in range(14):
        steps = np.cumsum(rng.normal(0, 9, (20, 2)) + rng.normal(0, 9, 2), axis=0)
        line = (rng.uniform(0, [w, h]) + steps).astype(np.int32)
        cv2.polylines(out, [line], False, [0.12] * 3, int(rng.integers(1, 3)), cv2.LINE_AA)
    return out


def meadow(rng: Rng, h: int, w: int, tint: Floats) -> Floats:
    """Grass from above: short strokes of many greens over soft patches."""
    out = np.ascontiguousarray(tint * (0.8 + 0.12 * fractal(rng, h, w, 256, 4))[..., None], dtype=np.float32)
    count = h * w // 120
    root = rng.uniform(0, [w, h], (count, 2))
    tip = root + rng.normal(0, 5, (count, 2))
    for a, b, s in zip(root.astype(int).tolist(), tip.astype(int).tolist(), rng.normal(1, 0.28, count), strict=True):
        cv2.line(out, a, b, (tint * s).tolist(), 1, cv2.LINE_AA)
    return out


def cloth(rng: Rng, h: int, w: int) -> Floats:
    """A carpet: a border and mirrored ornaments in a few colours."""
    palette = [colour(rng, (0, 1), (0.3, 0.8), (0.25, 0.85)) for _ in range(5)]
    quarter = blank(h // 2, w // 2, palette[0])
    for _ in range(45):
        p = rng.uniform(0, [w // 2, h // 2], (3, 2))
        tone = palette[int(rng.integers(1, 5))].tolist()
        if rng.random() < 0.5:
            cv2.fillPoly(quarter, [p.mean(0).astype(np.int32) + rng.normal(0, w / 24, (4, 2)).astype(np.int32)], tone)
        else:
            cv2.circle(quarter, p[0].astype(int).tolist(), int(rng.uniform(3, w / 20)), tone, int(rng.choice([-1, 2])))
    for i, inset in enumerate((0, 10, 16)):
        cv2.rectangle(quarter, (inset, inset), (w, h), palette[i + 1].tolist(), 5)
    half = np.concatenate([quarter, quarter[:, ::-1]], axis=1)
    out = np.concatenate([half, half[::-1]], axis=0)
    out = cv2.resize(out, (w, h))
    return (out * (1 + 0.10 * fractal(rng, h, w, 4, 1, 0.9))[..., None]).astype(np.float32)


def leaves(rng: Rng, size: int, tint: Floats) -> Pixels:
    """A cloud of leaves with opacity (size, size, 4)."""
    count, out = 320, np.zeros((size, size, 4), dtype=np.float32)
    out[..., :3] = tint * 0.5
    radius = size * 0.42 * np.sqrt(rng.random(count))
    for r, a in zip(radius, rng.uniform(0, 2 * np.pi, count), strict=True):
        at = (int(size / 2 + r * np.cos(a)), int(size / 2 + r * np.sin(a)))
        tone = tint * rng.normal(1, 0.3) * (1.15 - 0.3 * np.sin(a) * r / size)
        axes = (int(rng.uniform(0.025, 0.055) * size), int(rng.uniform(0.012, 0.028) * size))
        cv2.ellipse(out, at, axes, rng.uniform(0, 180), 0, 360, (*np.clip(tone, 0, 1).tolist(), 1.0), -1, cv2.LINE_AA)
    return to_pixels(out)


def heaven(rng: Rng, cover: Real) -> Pixels:
    """A sky (256, 1024, 3): azimuth across, zenith on top, clouds over a gradient."""
    h, w = 256, 1024
    height = np.linspace(1, 0, h, dtype=np.float32)[:, None]
    blue, pale = colour(rng, (0.57, 0.62), (0.4, 0.65), (0.6, 0.9)), colour(rng, (0.55, 0.62), (0.05, 0.2), (0.8, 0.95))
    out = pale + (blue - pale) * (height**0.6)[..., None]
    veil = np.clip((fractal(rng, h, w, 128, 1, 0.58) + cover) * 0.7, 0, 1)[..., None]
    shade = np.clip(0.93 + 0.06 * fractal(rng, h, w, 64, 2), 0, 1)[..., None]
    return to_pixels((out * (1 - veil) + shade * veil).astype(np.float32))


def heights(rng: Rng, m: int, n: int, coarsest: int = 8) -> Vector:
    """A smooth random field (m, n) in [0, 1] for relief."""
    field = fractal(rng, m, n, coarsest, 1, 0.45).astype(np.float64)
    field -= field.min()
    return field / max(float(field.max()), 1e-9)


_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)


def blank(h: int, w: int, tone: Floats) -> Floats:
    """A picture of one colour."""
    return np.full((h, w, 3), tone, dtype=np.float32)


def word(rng: Rng, low: int = 3, high: int = 9) -> str:
    """Random letters."""
    return "".join(rng.choice(list(string.ascii_uppercase + "aeionrst"), int(rng.integers(low, high))))


def write(rng: Rng, out: Floats, text: str, box: tuple[int, int, int, int], tone: Floats) -> None:
    """A text as large as fits into the box (x, y, w, h)."""
    font, (x, y, w, h) = int(rng.choice(_FONTS)), box
    (tw, th), _ = cv2.getTextSize(text, font, 1.0, 2)
    scale = min(w / max(tw, 1), h / (th * 1.3))
    thick = max(1, round(2.2 * scale))
    ink = np.zeros(out.shape[:2], dtype=np.uint8)
    cv2.putText(ink, text, (x, y + int(h / 2 + th * scale / 2)), font, scale, 255, thick, cv2.LINE_AA)
    out += (ink.astype(np.float32) / 255)[..., None] * (tone - out)


def window(rng: Rng, h: int, w: int, style: np.random.SeedSequence) -> Floats:
    """A window: frame and bars by `style` (the same in all windows of a house), glass by `rng`."""
    same = np.random.default_rng(style)
    frame = colour(same, (0, 1), (0, 0.35), (0.3, 0.95))
    bars_x, bars_y = int(same.integers(1, 4)), int(same.integers(1, 5))
    shade = np.linspace(0.32, 0.12, h, dtype=np.float32)[:, None]
    tilt = np.linspace(-0.06, 0.06, w, dtype=np.float32)
    glass = (shade + tilt + 0.035 * fractal(rng, h, w, 64, 4))[..., None] * rgb(0.85, 1.0, 1.15)
    glass = np.ascontiguousarray(glass, dtype=np.float32)
    drape = rng.random()
    if drape < 0.55:  # curtains, or a blind
        tone = colour(rng, (0, 1), (0, 0.3), (0.5, 0.9))
        folds = 1 + 0.15 * np.sin(np.arange(w) * 2 * np.pi / max(4.0, w / 14)).astype(np.float32)
        reach = int(w * rng.uniform(0.15, 0.4))
        if drape < 0.35:
            glass[:, :reach] = tone * 0.6 * folds[:reach, None]
            glass[:, -reach:] = tone * 0.6 * folds[-reach:, None]
        else:
            glass[: int(h * rng.uniform(0.2, 0.8))] = tone * 0.6
    bar = max(1, w // 40)
    for i in range(1, bars_x + 1):
        x = i * w // (bars_x + 1)
        glass[:, x - bar : x + bar] = frame
    for i in range(1, bars_y + 1):
        y = i * h // (bars_y + 1)
        glass[y - bar : y + bar] = frame
    edge = max(2, w // 18)
    glass[:edge], glass[-edge:], glass[:, :edge], glass[:, -edge:] = frame, frame * 0.85, frame, frame * 0.9
    return glass


def door(rng: Rng, h: int, w: int) -> Floats:
    """A panelled door."""
    tone = colour(rng, (0, 1), (0.2, 0.7), (0.2, 0.6))
    out = np.ascontiguousarray(tone * (1 + 0.05 * fractal(rng, h, w, 64, 1))[..., None], dtype=np.float32)
    for i in range(2):
        for j in range(3):
            x, y = int(w * (0.08 + 0.46 * i)), int(h * (0.05 + 0.32 * j))
            cv2.rectangle(out, (x, y), (x + int(w * 0.38), y + int(h * 0.26)), (tone * 0.55).tolist(), max(1, w // 50))
    cv2.circle(out, (int(w * 0.9), h // 2), max(2, w // 25), (0.9, 0.8, 0.4), -1)
    return out


def sign(rng: Rng, h: int, w: int) -> Floats:
    """A shop sign: letters on a coloured board."""
    ground = colour(rng, (0, 1), (0.2, 0.95), (0.15, 0.9))
    ink = rgb(0.95, 0.95, 0.9) if ground.mean() < 0.5 else rgb(0.08, 0.06, 0.1)
    out = blank(h, w, ground)
    cv2.rectangle(out, (2, 2), (w - 3, h - 3), (ink * 0.8 + ground * 0.2).tolist(), max(1, h // 30))
    write(rng, out, word(rng), (int(w * 0.07), int(h * 0.12), int(w * 0.86), int(h * 0.76)), ink)
    return out


def poster(rng: Rng, h: int, w: int) -> Floats:
    """A poster: a gradient, overlapping shapes, lines of text."""
    a, b = colour(rng, (0, 1), (0.1, 0.8), (0.3, 1)), colour(rng, (0, 1), (0.1, 0.8), (0.2, 0.9))
    ramp = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
    out = np.ascontiguousarray(np.broadcast_to(a * (1 - ramp) + b * ramp, (h, w, 3)), dtype=np.float32)
    for _ in range(int(rng.integers(12, 40))):
        tone = colour(rng, (0, 1), (0.1, 0.9), (0.1, 1)).tolist()
        p = rng.uniform(0, [w, h])
        r = float(rng.uniform(0.02, 0.16)) * w
        kind = rng.random()
        if kind < 0.4:
            at, axes = p.astype(int).tolist(), (int(r), int(r * rng.uniform(0.3, 1)))
            cv2.ellipse(out, at, axes, rng.uniform(0, 180), 0, 360, tone, -1, cv2.LINE_AA)
        elif kind < 0.75:
            corners = (p + rng.normal(0, r, (int(rng.integers(3, 6)), 2))).astype(np.int32)
            cv2.fillPoly(out, [corners], tone, cv2.LINE_AA)
        else:
            write(rng, out, word(rng), (int(p[0] - r), int(p[1]), int(3 * r) + 8, int(r) + 6), rgb(*tone))
    return (out * (1 + 0.05 * fractal(rng, h, w, 128, 1))[..., None]).astype(np.float32)


def books(rng: Rng, h: int, w: int) -> Floats:
    """A row of book spines."""
    out = blank(h, w, rgb(0.08, 0.06, 0.05))
    x = 0
    while x < w:
        width = int(rng.uniform(0.02, 0.06) * w) + 6
        tall = int(h * rng.uniform(0.72, 0.98))
        tone = colour(rng, (0, 1), (0.1, 0.8), (0.2, 0.9))
        out[h - tall :, x : x + width - 1] = tone
        ink = rgb(0.95, 0.93, 0.85) if tone.mean() < 0.5 else rgb(0.1, 0.08, 0.08)
        title = blank(width, int(tall * 0.8), tone)
        write(rng, title, word(rng, 4, 14), (2, 1, title.shape[1] - 4, width - 2), ink)
        part = np.rot90(title)[:, : max(0, min(width - 1, w - x))]
        out[h - tall + int(tall * 0.1) :][: part.shape[0], x : x + part.shape[1]] = part
        band = h - int(tall * rng.uniform(0.04, 0.2))
        out[band : band + max(1, h // 60), x : x + width - 1] = ink
        x += width
    return out


def car_side(rng: Rng, tone: Floats) -> Pixels:
    """A car from the side (192, 512, 4), transparent round its outline."""
    h, w = 192, 512
    out = np.zeros((h, w, 4), dtype=np.float32)
    body = np.array([[6, 110], [60, 92], [150, 30], [330, 26], [420, 88], [500, 104], [508, 160], [4, 162]], np.int32)
    cv2.fillPoly(out, [body], (*tone.tolist(), 1.0))
    out[..., :3] *= np.linspace(1.25, 0.7, h, dtype=np.float32)[:, None, None]
    for glass in ([[110, 88], [162, 42], [235, 40], [235, 90]], [[247, 90], [247, 40], [322, 38], [385, 90]]):
        cv2.fillPoly(out, [np.array(glass, np.int32)], (0.12, 0.15, 0.18, 1.0))
    for x in (241, 120, 392):
        cv2.line(out, (x, 92), (x, 150), (*(tone * 0.5).tolist(), 1.0), 2)
    cv2.rectangle(out, (205, 102), (228, 108), (0.7, 0.7, 0.7, 1.0), -1)
    cv2.rectangle(out, (6, 112), (30, 126), (0.9, 0.3, 0.2, 1.0), -1)
    cv2.rectangle(out, (486, 108), (508, 122), (0.95, 0.95, 0.85, 1.0), -1)
    for x in (100, 405):
        cv2.circle(out, (x, 156), 34, (0.05, 0.05, 0.05, 1.0), -1)
        cv2.circle(out, (x, 156), 21, (0.6, 0.6, 0.62, 1.0), -1)
        for k in range(5):
            a = 2 * np.pi * k / 5 + float(rng.uniform(0, 1))
            cv2.line(out, (x, 156), (int(x + 19 * np.cos(a)), int(156 + 19 * np.sin(a))), (0.2, 0.2, 0.2, 1.0), 4)
    return to_pixels(out)


def car_end(rng: Rng, tone: Floats) -> Floats:
    """A car from behind (or from the front): screen, lamps, plate, bumper."""
    h, w = 192, 256
    out = blank(h, w, tone) * np.linspace(1.2, 0.65, h, dtype=np.float32)[:, None, None]
    cv2.fillPoly(out, [np.array([[38, 14], [218, 14], [240, 80], [16, 80]], np.int32)], (0.1, 0.13, 0.16))
    cv2.line(out, (16, 130), (240, 130), (tone * 0.5).tolist(), 3)
    cv2.rectangle(out, (8, 92), (48, 122), (0.85, 0.15, 0.1), -1)
    cv2.rectangle(out, (208, 92), (248, 122), (0.85, 0.15, 0.1), -1)
    cv2.rectangle(out, (0, 164), (w, h), (0.08, 0.08, 0.08), -1)
    cv2.rectangle(out, (88, 102), (168, 124), (0.95, 0.95, 0.8), -1)
    write(rng, out, word(rng, 6, 8), (92, 103, 72, 20), rgb(0.05, 0.05, 0.1))
    return out.astype(np.float32)


def person(rng: Rng) -> Pixels:
    """Somebody standing (256, 96, 4), transparent round the outline."""
    h, w = 256, 96
    out = np.zeros((h, w, 4), dtype=np.float32)
    skin = colour(rng, (0.04, 0.09), (0.25, 0.6), (0.4, 0.95))
    coat, trousers = colour(rng, (0, 1), (0.1, 0.9), (0.1, 0.9)), colour(rng, (0, 1), (0.1, 0.5), (0.1, 0.5))
    for x in (38, 58):
        cv2.line(out, (x, 140), (x + int(rng.integers(-8, 9)), 246), (*trousers.tolist(), 1.0), 17)
    cv2.ellipse(out, (48, 100), (25, 52), 0, 0, 360, (*coat.tolist(), 1.0), -1)
    for x, d in ((27, -1), (69, 1)):
        cv2.line(out, (x, 66), (x + d * int(rng.integers(0, 14)), 132), (*(coat * 0.85).tolist(), 1.0), 13)
    for y in range(60, 148, int(rng.integers(6, 16))):
        cv2.line(out, (28, y), (68, y), (*(coat * rng.uniform(0.5, 1.3)).tolist(), 1.0), 2)
    cv2.circle(out, (48, 30), 17, (*skin.tolist(), 1.0), -1)
    hair = colour(rng, (0, 0.15), (0, 0.7), (0.05, 0.6))
    cv2.ellipse(out, (48, 23), (18, 13), 0, 180, 360, (*hair.tolist(), 1.0), -1)
    return to_pixels(out)
