"""What the stress test does to a pair's matches: sweeps of one quantity, and conditions that hurt.

Each change takes a `Case` and gives another, or None where too few right matches would be left.
Images are not drawn again: the matches of the whole photographs are thinned out, moved or seen through a window.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.types import Correspondences
from scripts.benchmark.stress_cases import MIN_RIGHT, Case, on_plane, taken

Change = Callable[[Case], Case | None]

INLIER_RATIOS = (0.05, 0.1, 0.2, 0.4, 0.7, 0.95)
MAX_RIGHT = 150  # in the sweep of inlier ratios
NOISES = (0.0, 0.5, 1.0, 2.0, 4.0)  # px
MAX_MATCHES = 500  # in the sweep of noise
COUNTS = (20, 50, 100, 300, 1000, 4000)
OFF_PLANE = 0.1  # share of right matches that are left off the plane
WINDOW = 0.6  # of width and height
ZOOM = 2.5


def inlier_ratio(case: Case, ratio: float) -> Case | None:
    """The right matches with as many wrong ones as make this share of inliers; matches that are neither are left out.

    Right ones are as many at every ratio, at most MAX_RIGHT. Wrong ones are first the pair's own, then wrong nearest
    neighbours that the ratio test took away, with distance ratios drawn from those of the pair's own wrong matches.
    """
    rng, min_ratio = case.rng("inlier ratio"), min(INLIER_RATIOS)
    right, wrong = (rng.permutation(np.flatnonzero(mask.numpy())) for mask in (case.right, case.wrong))
    spare = rng.permutation(case.spare.mask.shape[1])
    most = int((len(wrong) + len(spare)) * min_ratio / (1 - min_ratio))
    right = right[: min(MAX_RIGHT, most)]
    if len(right) < MIN_RIGHT or len(wrong) < 2:
        return None
    count = round(len(right) * (1 - ratio) / ratio)
    own, added = wrong[:count], spare[: max(0, count - len(wrong))]
    kept = case.subset(torch.from_numpy(np.concatenate([right, own])))
    assert case.c.quality is not None
    drawn = case.c.quality[:, torch.from_numpy(rng.choice(wrong, len(added)))]
    more = taken(case.spare, torch.from_numpy(added)).replace(quality=drawn)
    away = torch.zeros(len(added), dtype=torch.bool)
    return dataclasses.replace(
        kept, c=_joined(kept.c, more), right=torch.cat([kept.right, away]), wrong=torch.cat([kept.wrong, ~away])
    )


def noise(case: Case, sigma: float) -> Case | None:
    """Gaussian noise of so many pixels added to every coordinate of the matches, of which at most MAX_MATCHES."""
    rng, n = case.rng("noise"), len(case.right)
    case = case.subset(torch.from_numpy(np.sort(rng.permutation(n)[:MAX_MATCHES])))
    shift = [torch.from_numpy(rng.normal(0, 1, tuple(case.c.x0.shape)) * sigma).to(case.c.x0) for _ in range(2)]
    return dataclasses.replace(case, c=_placed(case.c, case.c.x0 + shift[0], case.c.x1 + shift[1]))


def match_count(case: Case, count: float) -> Case | None:
    """So many of the matches, chosen at random; a smaller choice is part of a larger one."""
    order = case.rng("count").permutation(len(case.right))
    return case.subset(torch.from_numpy(order[: int(count)])) if len(order) >= count else None


def unchanged(case: Case) -> Case | None:
    return case


def plane(case: Case) -> Case | None:
    """Right matches off the dominant plane thinned out until they are a tenth of all right ones."""
    inside = on_plane(case)
    off = (case.right & ~inside).nonzero()[:, 0].numpy()
    most = int(inside.sum()) * OFF_PLANE / (1 - OFF_PLANE)
    if int(inside.sum()) < MIN_RIGHT:
        return None
    gone = case.rng("plane off").permutation(off)[round(most) :]
    keep = torch.ones_like(case.right)
    keep[torch.from_numpy(gone)] = False
    return case.subset(keep)


def crops(case: Case) -> Case | None:
    """Both images cropped to windows of 0.6 of width and height, anywhere."""
    rng = case.rng("crop")
    corners = []
    for size in sizes(case):
        h, w = size
        corners.append(np.floor(rng.random(2) * (1 - WINDOW) * [w, h]))
    return seen(
        case, *((corner, np.floor(WINDOW * size), 1.0) for corner, size in zip(corners, sizes(case), strict=True))
    )


def zoomed(case: Case) -> Case | None:
    """Image 1 cropped at its centre to 1 / ZOOM of its sides, image 0 reduced by ZOOM: of one size if they were."""
    size0, size1 = sizes(case)
    return seen(case, (np.zeros(2), np.floor(size0 / ZOOM), 1 / ZOOM), central(size1, np.floor(size1 / ZOOM)))


def cropped_once(case: Case) -> Case | None:
    """Image 1 cropped at its centre to 1 / ZOOM of its sides, image 0 as it is."""
    size0, size1 = sizes(case)
    return seen(case, (np.zeros(2), size0, 1.0), central(size1, np.floor(size1 / ZOOM)))


def focal_length(case: Case, f: float) -> Case | None:
    """Both images cropped or padded about their centres until their focal lengths are f of the longer sides."""
    pair = case.pair
    if pair.K0 is None or pair.K1 is None:
        return None
    windows = []
    for size, K in zip(sizes(case), (pair.K0, pair.K1), strict=True):
        now = float(np.sqrt(K[0, 0] * K[1, 1])) / float(size.max())
        windows.append(central(size, np.floor(size * now / f)))
    return seen(case, *windows)


SWEEPS: dict[str, dict[float, Change]] = {
    "inlier ratio": {ratio: functools.partial(inlier_ratio, ratio=ratio) for ratio in INLIER_RATIOS},
    "noise": {sigma: functools.partial(noise, sigma=sigma) for sigma in NOISES},
    "match count": {float(count): functools.partial(match_count, count=count) for count in COUNTS},
}
CONDITIONS: dict[str, Change] = {
    "as they are": unchanged,
    "one plane": plane,
    "crops": crops,
    "f 1 : 2.5, one size": zoomed,
    "f 1 : 2.5, two sizes": cropped_once,
    "f = 0.4": functools.partial(focal_length, f=0.4),
    "f = 2": functools.partial(focal_length, f=2.0),
    "f = 4": functools.partial(focal_length, f=4.0),
}

Window = tuple[NDArray[np.float64], NDArray[np.float64], float]
"""Of one image: upper left corner (x, y) and new size (h, w), in pixels, and the scale of the new image."""


def sizes(case: Case) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The images' (h, w)."""
    assert case.c.size0 is not None
    assert case.c.size1 is not None
    return case.c.size0[0].double().numpy(), case.c.size1[0].double().numpy()


def central(size: NDArray[np.float64], new: NDArray[np.float64]) -> Window:
    """The window of a new size (h, w) about the centre of an image; larger than the image: a border is added."""
    return (size - new)[::-1] / 2, new, 1.0


def seen(case: Case, window0: Window, window1: Window) -> Case | None:
    """The matches inside both windows, in the windows' pixels, with F of these; None: fewer than MIN_RIGHT right."""
    moved, inverse = [], []
    inside = torch.ones_like(case.right)
    for x, (corner, new, scale) in ((case.c.x0, window0), (case.c.x1, window1)):
        shift = scale * (0.5 - corner) - 0.5  # pixel (0, 0) has its centre there and its corner at -0.5
        y = scale * x[0].double() + torch.from_numpy(shift)
        inside &= ((y > -0.5) & (y < torch.from_numpy(new[::-1].copy()) - 0.5)).all(-1)
        moved.append(y[None])
        inverse.append(np.array([[1 / scale, 0, -shift[0] / scale], [0, 1 / scale, -shift[1] / scale], [0, 0, 1]]))
    if int((case.right & inside).sum()) < MIN_RIGHT:
        return None
    c = _placed(case.c, moved[0], moved[1], window0[2], window1[2])
    shapes = [torch.from_numpy(window[1].astype(np.int64))[None] for window in (window0, window1)]
    pair = dataclasses.replace(case.pair, F=inverse[1].T @ case.pair.F @ inverse[0], K0=None, K1=None)
    windowed = dataclasses.replace(case, pair=pair, c=c.replace(size0=shapes[0], size1=shapes[1]))
    return windowed.subset(inside)


def _placed(c: Correspondences, x0: Tensor, x1: Tensor, scale0: float = 1.0, scale1: float = 1.0) -> Correspondences:
    """The matches at other points, with their frames."""
    frames = {}
    for name, x, scale in (("lafs0", x0, scale0), ("lafs1", x1, scale1)):
        lafs = getattr(c, name)
        frames[name] = torch.cat([scale * lafs[..., :2], x[..., None].to(lafs)], -1)
    return c.replace(x0=x0.to(c.x0), x1=x1.to(c.x1), **frames)


def _joined(a: Correspondences, b: Correspondences) -> Correspondences:
    """The matches of two batches of one."""
    slots = [name for name in a.per_slot if getattr(a, name) is not None]
    return a.replace(**{name: torch.cat([getattr(a, name), getattr(b, name)], 1) for name in slots})
