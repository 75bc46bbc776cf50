"""Painted things: windows, doors, signs, posters, books, cars, people."""

from __future__ import annotations

import string

import cv2
import numpy as np

from fmtorch.data.rendered.mipmap import Floats, Pixels
from fmtorch.data.rendered.patterns import Rng, colour, fractal, rgb, to_pixels

_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)


def blank(h: int, w: int, tone: Floats) -> Floats:
    """A picture of one colour."""
    out = np.empty((h, w, 3), dtype=np.float32)
    out[:] = tone
    return out


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
    out = tone * (1 + 0.05 * fractal(rng, h, w, 64, 1))[..., None]
    out = np.ascontiguousarray(out, dtype=np.float32)
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
            cv2.ellipse(
                out, p.astype(int).tolist(), (int(r), int(r * rng.uniform(0.3, 1))), rng.uniform(0, 180), 0, 360,
                tone, -1, cv2.LINE_AA,
            )  # fmt: skip
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
    cv2.ellipse(
        out, (48, 23), (18, 13), 0, 180, 360, (*colour(rng, (0, 0.15), (0, 0.7), (0.05, 0.6)).tolist(), 1.0), -1
    )
    return to_pixels(out)
