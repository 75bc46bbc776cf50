"""Pairs whose configuration is known: planes, rotations, copies and crops of photographs, unrelated ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.types import Correspondences
from scripts.benchmark.homography_pairs import matched, small, warped

Array = NDArray[Any]
FOCAL = 1.2  # of the longer side: of warped photographs, and of the cameras given for copies
WIDE_FOCAL = 0.8  # of a photograph that is looked around in


class Case(NamedTuple):
    """Matches of one pair with cameras and sizes, and what it is.

    truth: a name of `CONFIGURATIONS`, or empty where that is not known. group: the row of the table. motion: the
    true R (3, 3) and t (3,), where they are known.
    """

    matches: Correspondences
    truth: str
    group: str
    name: str
    motion: tuple[Tensor, Tensor] | None = None


def photographs(paths: Sequence[Path]) -> Iterator[Case]:
    """Of each photograph a plane, a rotation, a copy, a crop and an unrelated pair."""
    if len(paths) < 2:
        raise SystemExit("error: two photographs at least are needed, of which one is behind the other")
    for seed, path in enumerate(paths):
        behind = paths[(seed + min(7, len(paths) - 1)) % len(paths)]
        case = warped(path, behind, seed)
        yield _case(case.matches, "planar", "warped photographs", path)
        for group, make in MAKERS.items():
            view0, view1, focals = make(np.random.default_rng([seed, len(group)]), small(path), small(behind))
            yield _case(matched(view0, view1), *TRUTHS[group], path, focals)


def _case(c: Correspondences, truth: str, group: str, path: Path, focals: Array | None = None) -> Case:
    """With cameras of square pixels; focals: (2,) px."""
    sizes = [s[0].numpy() for s in (c.size0, c.size1) if s is not None]
    known = [FOCAL * max(size) for size in sizes] if focals is None else list(focals)
    K0, K1 = (torch.from_numpy(_calibration(f, size))[None] for f, size in zip(known, sizes, strict=True))
    return Case(c.replace(K0=K0, K1=K1), truth, group, path.stem)


def _calibration(focal: float, size: Array) -> Array:
    h, w = size
    return np.array([[focal, 0, (w - 1) / 2], [0, focal, (h - 1) / 2], [0, 0, 1.0]])


def _noisy(rng: np.random.Generator, image: Array, blur: float = 0.6) -> Array:
    """Another exposure: blur, noise and JPEG."""
    image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur) + rng.normal(0, 3, image.shape)
    coded = cv2.imencode(".jpg", np.clip(image, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR))


def rotated(rng: np.random.Generator, photograph: Array, _: Array) -> tuple[Array, Array, Array]:
    """Two views from the centre of a photograph's camera, of different focal lengths, within its field of view."""
    h, w = photograph.shape[:2]
    K = _calibration(WIDE_FOCAL * max(h, w), np.array([h, w]))
    size = np.array([round(0.7 * h), round(0.7 * w)])
    views, focals = [], []
    for side in (-1, 1):
        focal = rng.uniform(0.9, 1.3) * max(size)
        angles = np.radians([rng.uniform(-6, 6), side * rng.uniform(3, 10), rng.uniform(-8, 8)])
        H = _calibration(focal, size) @ cv2.Rodrigues(angles)[0] @ np.linalg.inv(K)
        views.append(_noisy(rng, cv2.warpPerspective(photograph, H, (size[1], size[0]), flags=cv2.INTER_AREA)))
        focals.append(focal)
    return views[0], views[1], np.array(focals)


def copied(rng: np.random.Generator, photograph: Array, _: Array) -> tuple[Array, Array, None]:
    """The photograph, and a copy of another size and compression."""
    scale = rng.choice([1.0, rng.uniform(0.5, 1.0)])
    copy = cv2.resize(photograph, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return photograph, _compressed(rng, copy), None


def cropped(rng: np.random.Generator, photograph: Array, _: Array) -> tuple[Array, Array, None]:
    """The photograph, and a part of 60 to 90 % of its sides."""
    h, w = photograph.shape[:2]
    share = rng.uniform(0.6, 0.9)
    height, width = round(share * h), round(share * w)
    top, left = rng.integers(h - height + 1), rng.integers(w - width + 1)
    return photograph, _compressed(rng, photograph[top : top + height, left : left + width]), None


def _compressed(rng: np.random.Generator, image: Array) -> Array:
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(50, 95))])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR))


def unrelated(rng: np.random.Generator, photograph: Array, other: Array) -> tuple[Array, Array, None]:
    return photograph, other, None


MAKERS: dict[str, Callable[[np.random.Generator, Array, Array], tuple[Array, Array, Array | None]]] = {
    "rotations": rotated, "copies": copied, "crops": cropped, "unrelated": unrelated,
}  # fmt: skip
TRUTHS = {
    "rotations": ("rotation", "rotations cut from photographs"), "copies": ("identical", "copies, resized"),
    "crops": ("identical", "crops"), "unrelated": ("unrelated", "unrelated photographs"),
}  # fmt: skip
