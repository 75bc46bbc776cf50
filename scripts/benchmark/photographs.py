"""Pairs made of photographs: planes seen from the side, rotations, copies and crops, and unrelated photographs."""

import argparse
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch import match
from fmtorch.core.types import Correspondences
from fmtorch.data import ImagePair, ImageSource, read_image
from fmtorch.pipeline.pipeline import Outcome
from fmtorch.training.planes import Photograph, PlanePairs, PlaneViews
from scripts.benchmark.runner import Item

Array = NDArray[Any]
SIDE = 640  # px, the longer side of the photographs
HARD_RIGHT, HARD_WRONG_SHARE = 60, 0.7
GRID = 12  # points along each side of a view
FOCAL, WIDE_FOCAL = 1.2, 0.8  # of the longer side: of warped photographs and copies; of one that is looked around in
BEHIND = 7  # photographs further on is the one that is seen behind a plane


def add_options(parser: argparse.ArgumentParser, required: bool) -> None:
    """Which photographs: every second is for tuning, the others for the claim."""
    parser.add_argument("--photographs", type=Path, required=required, help="a folder of photographs")
    parser.add_argument("--tuning", action="store_true", help="the photographs for choosing constants")


def paths_of(arguments: argparse.Namespace) -> list[Path]:
    """The photographs that are asked for. Raises SystemExit for fewer than two."""
    paths = sorted(path for path in arguments.photographs.iterdir() if path.suffix in (".jpg", ".png"))
    paths = paths[(0 if arguments.tuning else 1) :: 2][: arguments.limit]
    if len(paths) < 2:
        raise SystemExit("error: two photographs at least are needed, of which one is behind the other")
    return paths


@dataclasses.dataclass
class Plane(Item):
    """Two pictures of a plane. points: (n, 2), where an estimate of the homography is judged."""

    points: Array = dataclasses.field(default_factory=lambda: np.zeros((0, 2)))


def item_of(kind: str, path: Path, seed: int, c: Correspondences, points: Array | None = None, **known: Any) -> Plane:
    """A pair that is made of a photograph, with its matches."""
    image = ImageSource(path.name, path)
    pair = ImagePair(f"{kind}/{path.name}/{seed}", kind, path.stem, image, image, np.zeros((3, 3)), **known)
    outcome = Outcome(pair, (c.mask.shape[1],) * 2, c)
    return Plane(pair, lambda: outcome, points=np.zeros((0, 2)) if points is None else points)


def warped(paths: Sequence[Path], warps: int, hard_too: bool = True) -> Iterator[Plane]:
    """Each photograph as a plane seen from the side over another; of each the same with few right matches."""
    for seed, path in ((i + 1000 * k, path) for k in range(warps) for i, path in enumerate(paths)):
        image, background = small(path), small(paths[(seed % 1000 + min(BEHIND, len(paths) - 1)) % len(paths)])
        view, H = tilted(np.random.default_rng(seed), image, background)
        h, w = image.shape[:2]
        corners = np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], float)
        c = matched(image, view)
        yield item_of("warped", path, seed, c, corners, H=H)
        if hard_too:
            yield item_of("hard", path, seed, hard(c, H, seed), corners, H=H)


def tilted(rng: np.random.Generator, image: Array, background: Array) -> tuple[Array, Array]:
    """A photograph as a plane before a pinhole camera that looks at it from the side, and the homography to that."""
    h, w = image.shape[:2]
    tilt, direction, turn = np.deg2rad([rng.uniform(20, 55), rng.uniform(0, 360), rng.uniform(-20, 20)])
    axes = tilt * np.array([np.cos(direction), np.sin(direction), 0.0]), np.array([0, 0, turn])
    R = cv2.Rodrigues(axes[0])[0] @ cv2.Rodrigues(axes[1])[0]
    focal = FOCAL * max(h, w)
    plane = np.array([[1, 0, -w / 2], [0, 1, -h / 2], [0, 0, 1.0]])  # its points, in the plane's own frame
    camera = np.array([[focal, 0, w / 2], [0, focal, h / 2], [0, 0, 1.0]])
    H = camera @ np.c_[R[:, :2], [0, 0, focal * rng.uniform(1.0, 1.3)]] @ plane
    view = cv2.warpPerspective(image, H, (w, h), flags=cv2.INTER_AREA)
    inside = cv2.warpPerspective(np.ones((h, w), np.float32), H, (w, h))[..., None]
    view = cv2.GaussianBlur(inside * view + (1 - inside) * cv2.resize(background, (w, h)), (0, 0), 0.6)
    return np.clip(view + rng.normal(0, 3, view.shape), 0, 255).astype(np.uint8), H / np.linalg.norm(H)


def views(paths: Sequence[Path], count: int) -> Iterator[Plane]:
    """So many pairs of views of each photograph, kept in the cache folder, that see a tenth of the grid in common."""
    for seed, path in ((seed, path) for seed in range(count) for path in paths):
        pairs = PlanePairs([Photograph(path, path.name)], PlaneViews(views=2), seed)
        (pair,) = pairs
        images = [_read(image.path) for image in (pair.image0, pair.image1)]
        H, sizes = pairs.homography(pair), [np.array(image.shape[1::-1]) for image in images]
        grid = np.stack(np.meshgrid(*(np.linspace(0, side - 1, GRID) for side in sizes[0])), -1).reshape(-1, 2)
        there = mapped(H, grid)
        seen = (there >= 0).all(1) & (there < sizes[1]).all(1) & (grid @ H[2, :2] + H[2, 2] > 0)
        if seen.mean() >= 0.1:
            yield item_of("views", path, seed, matched(*images), grid[seen], H=H)


def hard(c: Correspondences, H: Array, seed: int) -> Correspondences:
    """At most HARD_RIGHT right matches, and random ones beside them; no prior."""
    rng = np.random.default_rng(seed)
    x0, x1 = points(c)
    right = np.flatnonzero(np.linalg.norm(mapped(H, x0) - x1, axis=1) < 2)
    right = rng.permutation(right)[:HARD_RIGHT]
    wrong = round(len(right) * HARD_WRONG_SHARE / (1 - HARD_WRONG_SHARE))
    a = np.concatenate([x0[right], rng.uniform(x0.min(0), x0.max(0), (wrong, 2))])
    b = np.concatenate([x1[right], rng.uniform(x1.min(0), x1.max(0), (wrong, 2))])
    order = rng.permutation(len(a))
    x = [torch.from_numpy(v[order][None]) for v in (a, b)]
    return Correspondences(x[0], x[1], torch.ones(x[0].shape[:2], dtype=torch.bool), key=torch.tensor([seed]))


def kinds(paths: Sequence[Path]) -> Iterator[Plane]:
    """Of each photograph a plane, a rotation, a copy, a crop and an unrelated pair, with cameras; facts: its truth."""
    for seed, plane in enumerate(warped(paths, 1, hard_too=False)):
        path, behind = paths[seed], paths[(seed + min(BEHIND, len(paths) - 1)) % len(paths)]
        yield _with_cameras("warped photographs", "planar", path, plane.matches, None)
        for name, (group, truth, make) in MAKERS.items():
            rng = np.random.default_rng([seed, len(name)])
            view0, view1, focals = make(rng, small(path), small(behind))
            yield _with_cameras(group, truth, path, matched(view0, view1), focals)


def _with_cameras(group: str, truth: str, path: Path, c: Correspondences, focals: Array | None) -> Plane:
    """Cameras of square pixels; focals: (2,) px."""
    sizes = [s[0].numpy() for s in (c.size0, c.size1) if s is not None]
    known = [FOCAL * max(size) for size in sizes] if focals is None else list(focals)
    K0, K1 = (calibration(f, size) for f, size in zip(known, sizes, strict=True))
    fields = {name: torch.from_numpy(K)[None] for name, K in (("K0", K0), ("K1", K1))}
    item = item_of(group, path, 0, c.replace(**fields), K0=K0, K1=K1)
    item.facts["truth"] = truth
    return item


def calibration(focal: float, size: Array) -> Array:
    """Of square pixels and a central principal point; size: (h, w)."""
    h, w = size
    return np.array([[focal, 0, (w - 1) / 2], [0, focal, (h - 1) / 2], [0, 0, 1.0]])


def _rotated(rng: np.random.Generator, photograph: Array, _: Array) -> tuple[Array, Array, Array]:
    """Two views from the centre of a photograph's camera, of different focal lengths, within its field of view."""
    h, w = photograph.shape[:2]
    K = calibration(WIDE_FOCAL * max(h, w), np.array([h, w]))
    size = np.array([round(0.7 * h), round(0.7 * w)])
    views, focals = [], []
    for side in (-1, 1):
        focal = rng.uniform(0.9, 1.3) * max(size)
        angles = np.radians([rng.uniform(-6, 6), side * rng.uniform(3, 10), rng.uniform(-8, 8)])
        H = calibration(focal, size) @ cv2.Rodrigues(angles)[0] @ np.linalg.inv(K)
        view = cv2.warpPerspective(photograph, H, (size[1], size[0]), flags=cv2.INTER_AREA)
        noisy = cv2.GaussianBlur(view.astype(np.float32), (0, 0), 0.6) + rng.normal(0, 3, view.shape)
        views.append(_compressed(np.clip(noisy, 0, 255).astype(np.uint8), 90))
        focals.append(focal)
    return views[0], views[1], np.array(focals)


def _copied(rng: np.random.Generator, photograph: Array, _: Array) -> tuple[Array, Array, None]:
    """The photograph, and a copy of another size and compression."""
    scale = rng.choice([1.0, rng.uniform(0.5, 1.0)])
    copy = cv2.resize(photograph, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return photograph, _compressed(copy, int(rng.integers(50, 95))), None


def _cropped(rng: np.random.Generator, photograph: Array, _: Array) -> tuple[Array, Array, None]:
    """The photograph, and a part of 60 to 90 % of its sides."""
    h, w = photograph.shape[:2]
    share = rng.uniform(0.6, 0.9)
    height, width = round(share * h), round(share * w)
    top, left = rng.integers(h - height + 1), rng.integers(w - width + 1)
    part = photograph[top : top + height, left : left + width]
    return photograph, _compressed(part, int(rng.integers(50, 95))), None


def _compressed(image: Array, quality: int) -> Array:
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR))


Maker = Callable[[np.random.Generator, Array, Array], tuple[Array, Array, Array | None]]
MAKERS: dict[str, tuple[str, str, Maker]] = {
    "rotations": ("rotations cut from photographs", "rotation", _rotated),
    "copies": ("copies, resized", "identical", _copied),
    "crops": ("crops", "identical", _cropped),
    "unrelated": ("unrelated photographs", "unrelated", lambda rng, photograph, other: (photograph, other, None)),
}


def small(path: Path) -> Array:
    """A photograph whose longer side is SIDE, BGR."""
    image = _read(path)
    scale = SIDE / max(image.shape[:2])
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _read(path: Path) -> Array:
    """A photograph, BGR."""
    return np.asarray(read_image(path)[..., ::-1])


def matched(image0: Array, image1: Array) -> Correspondences:
    """Matches of two images, BGR."""
    images = [np.ascontiguousarray(image[..., ::-1]) for image in (image0, image1)]
    return match(images[0], images[1], pipeline="sift_fmtorch").correspondences


def mapped(H: Array, x: Array) -> Array:
    """Points (n, 2) by a homography."""
    y = np.c_[x, np.ones(len(x))] @ H.T
    return np.asarray(y[:, :2] / y[:, 2:])


def points(c: Correspondences) -> tuple[Array, Array]:
    """The matches of a batch of one, (n, 2) each."""
    x0, x1 = (x[0][c.mask[0]].double().numpy() for x in (c.x0, c.x1))
    return x0, x1
