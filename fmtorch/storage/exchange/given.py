"""What the readers share: matches as correspondences, pairs of known cameras, sizes of images."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from fmtorch.core.types import Correspondences
from fmtorch.data.pairs import GivenMatches, ImagePair, ImageSource
from fmtorch.data.text_files import DataError
from fmtorch.geometry.cameras import fundamental_from_projections

Array = NDArray[np.float64]
Size = tuple[int, int]  # (h, w)


def given(
    x0: Array,
    x1: Array,
    sizes: tuple[Size, Size],
    features: tuple[int, int],
    quality: Array | None = None,
    mutual: NDArray[np.bool_] | None = None,
) -> GivenMatches:
    """Matches of one pair, (n, 2) in pixels each; those that are not finite do not count.

    quality: (n,), smaller is better. mutual: (n,). features: how many keypoints each image has.
    """
    p0, p1 = (torch.from_numpy(np.ascontiguousarray(x, np.float32))[None] for x in (x0, x1))
    mask = torch.from_numpy(np.isfinite(x0).all(-1) & np.isfinite(x1).all(-1))[None]
    return GivenMatches(
        Correspondences(
            torch.where(mask[..., None], p0, 0.0), torch.where(mask[..., None], p1, 0.0), mask,
            quality=None if quality is None else torch.from_numpy(quality.astype(np.float32))[None],
            mutual=None if mutual is None else torch.from_numpy(mutual)[None] & mask,
            size0=torch.tensor([sizes[0]]), size1=torch.tensor([sizes[1]]),
        ),
        features,
    )  # fmt: skip


def calibrated(
    identity: str, family: str, scene: str, images: tuple[ImageSource, ImageSource], K: tuple[Array, Array],
    R: Array, t: Array,
) -> ImagePair:  # fmt: skip
    """A pair of cameras with X1 = R X0 + t, and the F of these; a problem where they define none."""
    return with_fundamentals([posed(identity, family, scene, images, K, R, t)])[0]


def posed(
    identity: str, family: str, scene: str, images: tuple[ImageSource, ImageSource], K: tuple[Array, Array],
    R: Array, t: Array,
) -> ImagePair:  # fmt: skip
    """The same without F, which `with_fundamentals` adds."""
    problem = None
    if abs(np.linalg.det(K[0])) == 0 or abs(np.linalg.det(K[1])) == 0:
        problem = "a calibration matrix is singular"
    elif np.abs(R @ R.T - np.eye(3)).max() > 1e-2:
        problem = "R is no rotation"
    elif not t.any():
        problem = "the cameras did not move apart (t is zero), which leaves no F"
    return ImagePair(identity, family, scene, *images, np.zeros((3, 3)), *K, R, t, problem)


def with_fundamentals(pairs: Sequence[ImagePair]) -> list[ImagePair]:
    """The pairs with the F of their cameras, all at once; those with a problem, or without a pose, as they are."""
    result = list(pairs)
    places, first, second = list[int](), list[Array](), list[Array]()
    for place, pair in enumerate(pairs):
        if pair.problem is None and not (pair.K0 is None or pair.K1 is None or pair.R is None or pair.t is None):
            places.append(place)
            first.append(pair.K0 @ np.eye(3, 4))
            second.append(pair.K1 @ np.column_stack([pair.R, pair.t]))
    if places:
        F = fundamental_from_projections(*(torch.from_numpy(np.stack(P)) for P in (first, second))).numpy()
        for place, own in zip(places, F, strict=True):
            result[place] = dataclasses.replace(pairs[place], F=own)
    return result


def broken(identity: str, family: str, scene: str, images: tuple[ImageSource, ImageSource], problem: str) -> ImagePair:
    """A pair that cannot be used, which becomes a row with this reason."""
    return ImagePair(identity, family, scene, *images, np.zeros((3, 3)), problem=problem)


def image(family: str, scene: str, name: str, folder: Path | None) -> ImageSource:
    """An image of which only the name is known, in a folder where one is given."""
    return ImageSource(f"{family}/{scene}/{name}", (folder or Path()) / name)


def size_of(source: ImageSource) -> Size | None:
    """(h, w) from an image's header, None where there is no image."""
    try:
        with Image.open(source.path) as picture:
            return picture.height, picture.width
    except OSError:
        return None


def size_by_centre(K: Array) -> Size:
    """(h, w) of an image whose principal point is its centre: the best guess where nothing else tells it."""
    width, height = 2 * K[0, 2] + 1, 2 * K[1, 2] + 1
    if not (np.isfinite(width) and np.isfinite(height) and width >= 2 and height >= 2):
        raise DataError("the image sizes are unknown, and the principal point is no centre of an image; give images")
    return round(height), round(width)
