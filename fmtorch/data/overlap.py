"""How much of what one image of a pair shows the other shows too, whatever features find: by depth, or by points.

The overlap of a pair is the smaller of two shares, that of image 0 seen in image 1 and that of image 1 seen in image 0.
By depth a share is one of pixels, as for SuperGlue's training pairs (Sarlin et al., CVPR 2020, supplement), where the
two are averaged. By points it is one of the points of a reconstruction that an image sees, as in the matrix of overlaps
that D2-Net made of MegaDepth (Dusmanu et al., CVPR 2019), which keeps both.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fmtorch.data.images import read_image
from fmtorch.data.pairs import DepthDataset, ImageSource
from fmtorch.data.scenes import Indices, ScenePairs, View, image_pair, incidence

STEP = 4  # px between the pixels of which depth is asked, along rows and columns
TOLERANCE = 0.05  # by which depths may differ, relative to the one seen, for the same surface

Matrix = NDArray[np.float64]
Place = tuple[int, int, int]
"""Number of the scene, and of its two views."""


def overlap_of(dataset: ScenePairs) -> DepthOverlap | PointOverlap:
    """Overlaps by depth where the data set knows it, else by points. Raises ValueError where it has neither."""
    if isinstance(dataset, DepthDataset):
        return DepthOverlap(dataset)
    if dataset.points is not None:
        return PointOverlap(dataset.points)
    raise ValueError(
        f"overlap needs depth or the points of a reconstruction and dataset={dataset.name} has neither; it must be "
        "rendered, colmap, bundler, or tum with depth images"
    )


class PointOverlap:
    """By the points of reconstructions; points: of each scene a function that reads which points each view sees."""

    def __init__(self, points: Sequence[Callable[[], Sequence[Indices]]]) -> None:
        self.points = points
        self._last: tuple[int, scipy.sparse.csr_array] | None = None  # a scene, and which of its views sees what

    @property
    def record(self) -> dict[str, Any]:
        """How overlaps are defined."""
        return {"by": "points"}

    def of(self, place: Place) -> float:
        """The overlap of a pair, from 0 to 1: points that both views see, over those of the view that sees more."""
        scene, i, j = place
        last = self._last
        if last is None or last[0] != scene:
            last = self._last = scene, incidence(self.points[scene]())
        return float(shared_points(last[1], np.array([[i, j]]))[0])


def shared_points(sees: scipy.sparse.csr_array, pairs: Indices) -> Matrix:
    """Overlaps (n,) of pairs (n, 2) of images: points that both see, over those of the image that sees more of them.

    sees: which image sees which point, as `incidence` gives it. Zero where an image sees none.
    """
    counts = np.diff(sees.indptr)[pairs]
    shared = sees[pairs[:, 0]].multiply(sees[pairs[:, 1]]).sum(1)
    larger = counts.max(1, initial=0)
    overlaps: Matrix = np.divide(shared, larger, out=np.zeros(len(pairs)), where=larger > 0)
    return overlaps


class Seen(NamedTuple):
    """An image as a share of its pixels needs it: K (3, 3), size (h, w), and depth (n,) at points (n, 2)."""

    K: Matrix
    size: tuple[int, int]
    depth: Callable[[Matrix], Matrix]


class DepthOverlap:
    """By the depth of pixels; dataset: a `ScenePairs` with depth."""

    def __init__(self, dataset: ScenePairs) -> None:
        assert isinstance(dataset, DepthDataset)
        self.dataset, self._depth = dataset, dataset.depth

    @property
    def record(self) -> dict[str, Any]:
        """How overlaps are defined."""
        return {"by": "depth", "step_px": STEP, "tolerance": TOLERANCE}

    def of(self, place: Place) -> float:
        """The overlap of a pair, from 0 to 1. Raises ImageError where a depth image cannot be read."""
        scene, i, j = place
        views = self.dataset.scenes[scene].views
        pair = image_pair(self.dataset.scenes[scene], i, j)
        assert pair.R is not None
        assert pair.t is not None
        a, b = self._seen(views[i]), self._seen(views[j])
        return min(seen_share(a, b, pair.R, pair.t), seen_share(b, a, pair.R.T, -pair.R.T @ pair.t))

    def _seen(self, view: View) -> Seen:
        return Seen(view.K, _size(view.image), functools.partial(self._depth, view.image))


def seen_share(image: Seen, other: Seen, R: Matrix, t: Matrix, step: int = STEP) -> float:
    """The share of an image's pixels with depth that another image sees.

    A pixel is seen where its point X, which is ``R X + t`` to the other camera, lies within the other image and has the
    depth that is known there, to `TOLERANCE`. Pixels for which no depth is known there are left out.

    Args:
        image, other: calibration, size and depth; both depths in the unit of t.
        R, t: (3, 3) and (3,), from the camera of the image to the other's.
        step: px between the pixels that are looked at.

    Returns:
        The share, 0 where no pixel counts.
    """
    h, w = image.size
    rows, columns = np.mgrid[step // 2 : h : step, step // 2 : w : step].reshape(2, -1).astype(np.float64)
    depth = image.depth(np.stack([columns, rows], 1))
    has = np.isfinite(depth)
    rays = np.stack([columns, rows, np.ones_like(rows)], 1)[has] @ np.linalg.inv(image.K).T
    X = (rays * depth[has, None]) @ R.T + t
    ahead = X[X[:, 2] > 0]
    x = ahead @ other.K.T
    x = x[:, :2] / x[:, 2:]
    within = ((x >= -0.5) & (x < np.array(other.size[::-1]) - 0.5)).all(1)
    known = other.depth(x[within])
    unknown = np.isnan(known)
    same = np.abs(known - ahead[within, 2]) <= TOLERANCE * known
    count = len(X) - unknown.sum()
    return float(same.sum() / count) if count else 0.0


def _size(image: ImageSource) -> tuple[int, int]:
    """(h, w) of an image, which is read where the data set does not say it."""
    if image.size is not None:
        return image.size
    h, w = read_image(image).shape[:2]
    return h, w
