"""What the readers share: matches as correspondences, pairs of known cameras, sizes of images."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core.types import Correspondences
from fmtorch.data.pairs import GivenMatches, ImagePair, ImageSource
from fmtorch.data.text_files import DataError
from fmtorch.geometry.cameras import fundamental_from_projections

Array = NDArray[np.float64]
Size = tuple[int, int]  # (h, w)
MAX_OFF_CENTRE = 0.1  # of a principal point, in units of the side: those of reduced images are farther off
_ZERO = np.zeros((3, 3))  # where there is no F


def given(
    x0: Array,
    x1: Array,
    sizes: tuple[Size, Size],
    features: tuple[int, int],
    *,
    ratio: Array | None = None,
    score: Array | None = None,
    mutual: NDArray[np.bool_] | None = None,
) -> GivenMatches:
    """Matches of one pair, (n, 2) in pixels each; those that are not finite do not count.

    ratio, score, mutual: (n,), as of `Correspondences`. features: how many keypoints each image has.
    """
    p0, p1 = (torch.from_numpy(np.ascontiguousarray(x, np.float32))[None] for x in (x0, x1))
    mask = torch.from_numpy(np.isfinite(x0).all(-1) & np.isfinite(x1).all(-1))[None]
    return GivenMatches(
        Correspondences(
            torch.where(mask[..., None], p0, 0.0), torch.where(mask[..., None], p1, 0.0), mask,
            ratio=_figure(ratio), score=_figure(score),
            mutual=None if mutual is None else torch.from_numpy(mutual)[None] & mask,
            size0=torch.tensor([sizes[0]]), size1=torch.tensor([sizes[1]]),
        ),
        features,
    )  # fmt: skip


def _figure(values: Array | None) -> torch.Tensor | None:
    return None if values is None else torch.from_numpy(values.astype(np.float32))[None]


def calibrated(
    identity: str, family: str, scene: str, images: tuple[ImageSource, ImageSource], K: tuple[Array, Array],
    R: Array, t: Array,
) -> ImagePair:  # fmt: skip
    """A pair of cameras with X1 = R X0 + t, and the F of these; a problem where they define none."""
    return with_fundamentals([posed(identity, family, scene, images, K, R, t)])[0]


def posed(
    identity: str, family: str, scene: str, images: tuple[ImageSource, ImageSource], K: tuple[Array, Array],
    R: Array, t: Array, matches: Callable[[], GivenMatches] | None = None,
) -> ImagePair:  # fmt: skip
    """The same, of which `with_fundamentals` finds F or the problem."""
    return ImagePair(identity, family, scene, *images, _ZERO, *K, R, t, None, matches)


def with_fundamentals(pairs: Sequence[ImagePair]) -> list[ImagePair]:
    """The pairs with the F of their cameras, all at once; those with a problem, or without a pose, as they are."""
    result = list(pairs)
    places = [i for i, p in enumerate(pairs) if p.problem is None and p.R is not None]
    if not places:
        return result
    K0, K1, R, t = (np.stack([getattr(pairs[i], name) for i in places]) for name in ("K0", "K1", "R", "t"))
    wrong = {
        "the cameras did not move apart (t is zero), which leaves no F": ~t.any(1),
        "R is no rotation": np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2)) > 1e-2,
        "a calibration matrix is singular": (np.linalg.det(K0) == 0) | (np.linalg.det(K1) == 0),
    }
    problems: list[str | None] = [None] * len(places)
    for problem, where in wrong.items():  # the last that holds counts
        for i in np.flatnonzero(where):
            problems[i] = problem
    P0, P1 = K0 @ np.eye(3, 4), K1 @ np.concatenate([R, t[..., None]], -1)
    F = fundamental_from_projections(torch.from_numpy(P0), torch.from_numpy(P1)).numpy()
    for place, own, wrongly in zip(places, F, problems, strict=True):
        result[place] = dataclasses.replace(pairs[place], F=own if wrongly is None else _ZERO, problem=wrongly)
    return result


def broken(identity: str, family: str, scene: str, images: tuple[ImageSource, ImageSource], problem: str) -> ImagePair:
    """A pair that cannot be used, which becomes a row with this reason."""
    return ImagePair(identity, family, scene, *images, np.zeros((3, 3)), problem=problem)


def image(family: str, scene: str, name: str, folder: Path | None) -> ImageSource:
    """An image of which only the name is known, in a folder, or its sub-folder of the scene, where one is given."""
    path = Path(name)
    if folder is not None:
        path = folder / scene / name if (folder / scene).is_dir() else folder / name
    return ImageSource(f"{family}/{scene}/{name}", path)


def expect_size(source: ImageSource, size: Size, K: Array) -> None:
    """Raises DataError where an image's size (h, w) contradicts its camera: a copy that was reduced or cropped."""
    h, w = size
    if max(abs(K[0, 2] / w - 0.5), abs(K[1, 2] / h - 0.5)) > MAX_OFF_CENTRE:
        raise DataError(
            f"{source.path}: {w} x {h} px, but its camera's principal point is ({K[0, 2]:g}, {K[1, 2]:g}); it must be "
            "the image as it was when its camera was determined"
        )


def size_by_points(K: Array, x: Array) -> Size:
    """(h, w) of an image of unknown size: its principal point is the centre, and it holds all of the points (n, 2)."""
    bound = x[np.isfinite(x).all(-1)].max(0, initial=0.0)
    width, height = (max(2 * float(c) + 1, np.ceil(b) + 1) for c, b in zip(K[:2, 2], bound, strict=True))
    return round(height), round(width)


def size_by_centre(K: Array) -> Size:
    """(h, w) of an image whose principal point is its centre: the best guess where nothing else tells it."""
    width, height = 2 * K[0, 2] + 1, 2 * K[1, 2] + 1
    if not (np.isfinite(width) and np.isfinite(height) and width >= 2 and height >= 2):
        raise DataError("the image sizes are unknown, and the principal point is no centre of an image; give images")
    return round(height), round(width)
