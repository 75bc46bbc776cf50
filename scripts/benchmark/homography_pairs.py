"""Pairs of photographs seen as planes, with their matches and true homographies, for `benchmark homography`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from fmtorch import match
from fmtorch.core.types import Correspondences
from fmtorch.training.planes import Photograph, PlanePairs, PlaneViews
from scripts.benchmark.matched import console

Array = NDArray[Any]
SIDE = 640  # px, the longer side of the photographs
HARD_RIGHT, HARD_WRONG_SHARE = 60, 0.7
GRID = 12  # points along each side of a view


class Case(NamedTuple):
    """Matches of two pictures of a plane and their true homography.

    points: (n, 2), where the estimate is judged. name: of the photograph.
    """

    matches: Correspondences
    H: Array
    points: Array
    name: str


def warped(path: Path, behind: Path, seed: int) -> Case:
    """A photograph as a plane before a pinhole camera that looks at it from the side, over another photograph."""
    rng = np.random.default_rng(seed)
    image, background = (small(p) for p in (path, behind))
    h, w = image.shape[:2]
    tilt, direction, turn = np.deg2rad([rng.uniform(20, 55), rng.uniform(0, 360), rng.uniform(-20, 20)])
    focal, centre = 1.2 * max(h, w), np.array([w / 2, h / 2])
    R = (
        cv2.Rodrigues(tilt * np.array([np.cos(direction), np.sin(direction), 0.0]))[0]
        @ cv2.Rodrigues(np.array([0, 0, turn]))[0]
    )
    plane = np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, 1.0]])  # its points, in the plane's own frame
    camera = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    H = camera @ np.c_[R[:, :2], [0, 0, focal * rng.uniform(1.0, 1.3)]] @ plane
    view = cv2.warpPerspective(image, H, (w, h), flags=cv2.INTER_AREA)
    inside = cv2.warpPerspective(np.ones((h, w), np.float32), H, (w, h))[..., None]
    view = cv2.GaussianBlur(inside * view + (1 - inside) * cv2.resize(background, (w, h)), (0, 0), 0.6)
    noisy = np.clip(view + rng.normal(0, 3, view.shape), 0, 255).astype(np.uint8)
    corners = np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], float)
    return Case(matched(image, noisy), H / np.linalg.norm(H), corners, path.stem)


def views(paths: list[Path], count: int) -> list[Case]:
    """So many pairs of views of each photograph, kept in the cache folder, that see a tenth of the grid in common."""
    cases = []
    for seed in range(count):
        for path in track(paths, "views", console=console):
            planes = PlanePairs([Photograph(path, path.name)], PlaneViews(views=2), seed)
            (pair,) = planes
            images = [_read(image.path) for image in (pair.image0, pair.image1)]
            H, sizes = planes.homography(pair), [np.array(image.shape[1::-1]) for image in images]
            grid = np.stack(np.meshgrid(*(np.linspace(0, side - 1, GRID) for side in sizes[0])), -1).reshape(-1, 2)
            there = mapped(H, grid)
            seen = (there >= 0).all(1) & (there < sizes[1]).all(1) & (grid @ H[2, :2] + H[2, 2] > 0)
            if seen.mean() >= 0.1:
                cases.append(Case(matched(*images), H, grid[seen], path.stem))
    return cases


def small(path: Path) -> Array:
    """A photograph whose longer side is SIDE, BGR."""
    image = _read(path)
    scale = SIDE / max(image.shape[:2])
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _read(path: Path) -> Array:
    """A photograph, BGR."""
    image = cv2.imread(str(path))
    if image is None:
        raise SystemExit(f"error: {path} is no photograph that OpenCV reads")
    return np.asarray(image)


def matched(image0: Array, image1: Array) -> Correspondences:
    """Matches of two images, BGR."""
    images = [np.ascontiguousarray(image[..., ::-1]) for image in (image0, image1)]
    return match(images[0], images[1], pipeline="sift_fmtorch").correspondences


def hard(case: Case, seed: int) -> Case:
    """At most HARD_RIGHT right matches, and random ones beside them; no prior."""
    rng = np.random.default_rng(seed)
    x0, x1 = points(case.matches)
    right = np.flatnonzero(np.linalg.norm(mapped(case.H, x0) - x1, axis=1) < 2)
    right = rng.permutation(right)[:HARD_RIGHT]
    wrong = round(len(right) * HARD_WRONG_SHARE / (1 - HARD_WRONG_SHARE))
    a = np.concatenate([x0[right], rng.uniform(x0.min(0), x0.max(0), (wrong, 2))])
    b = np.concatenate([x1[right], rng.uniform(x1.min(0), x1.max(0), (wrong, 2))])
    order = rng.permutation(len(a))
    x = [torch.from_numpy(v[order][None]) for v in (a, b)]
    mask = torch.ones(x[0].shape[:2], dtype=torch.bool)
    return case._replace(matches=Correspondences(x[0], x[1], mask, key=torch.tensor([seed])))


def mapped(H: Array, x: Array) -> Array:
    y = np.c_[x, np.ones(len(x))] @ H.T
    return np.asarray(y[:, :2] / y[:, 2:])


def points(c: Correspondences) -> tuple[Array, Array]:
    return tuple(x[0][c.mask[0]].double().numpy() for x in (c.x0, c.x1))  # type: ignore[return-value]
