"""The item of every data set: an image pair with its ground truth, images read only when asked for."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fmtorch.core.types import Correspondences, pair_key
from fmtorch.data.lenses import Lens
from fmtorch.data.resampling import Resampling


@dataclasses.dataclass(frozen=True)
class ImageSource:
    """One image on disk.

    identity: names it within its data set.
    size: (h, w) that the file must have, where the data set says so: cameras hold for one size alone.
    lens: whose distortion `read_image` takes out; None for an image without.
    resampling: how `read_image` then resizes and turns it; None: not at all.
    data: the bytes of the file, for a worker that does not see it; None: they are read from `path`.
    """

    identity: str
    path: Path
    size: tuple[int, int] | None = None
    lens: Lens | None = None
    data: bytes | None = dataclasses.field(default=None, repr=False, compare=False)
    resampling: Resampling | None = None

    @property
    def pixels(self) -> tuple[Path, Lens | None, Resampling | None]:
        """What decides the pixels that `read_image` gives."""
        return self.path, self.lens, self.resampling


class GivenMatches(NamedTuple):
    """Matches of one pair that somebody else computed, and how many keypoints each image has."""

    correspondences: Correspondences
    features: tuple[int, int]


@dataclasses.dataclass(frozen=True, eq=False)
class ImagePair:
    """Two images of one scene and how they are related.

    identity: unique within the data set, e.g. ``Strecha/fountain-P11/3-7``.
    family: what results are grouped by (a data set, or a family of rendered scenes).
    scene: the cluster for the bootstrap, e.g. ``fountain-P11``.
    F: (3, 3) float64 with ``x1^T F x0 = 0`` in pixels.
    K0, K1: (3, 3), R: (3, 3), t: (3,) with ``X1 = R X0 + t``, where known.
    problem: why this pair cannot be used (a bad line of a pairs file, say); None for a sound pair.
    matches: reads the matches that come with the pair, in place of features and matcher; can be sent between processes.
    H: (3, 3) float64 with ``x1 ~ H x0`` in pixels, of a data set of homographies, whose F is zero; None for any other.
    """

    identity: str
    family: str
    scene: str
    image0: ImageSource
    image1: ImageSource
    F: NDArray[np.float64]
    K0: NDArray[np.float64] | None = None
    K1: NDArray[np.float64] | None = None
    R: NDArray[np.float64] | None = None
    t: NDArray[np.float64] | None = None
    problem: str | None = None
    matches: Callable[[], GivenMatches] | None = None
    H: NDArray[np.float64] | None = None

    @property
    def key(self) -> int:
        """The pair's stable 64-bit key."""
        return pair_key(self.identity)


@runtime_checkable
class PairDataset(Protocol):
    """A sequence of image pairs.

    name: e.g. ``fmbench``. digest: hex digest of what defines the pairs (contents of pairs files, or the generator's
    version and parameters; never an absolute path), part of a run's identity. One whose pairs have homographies in
    place of F says so by an attribute `model`, "homography".
    """

    name: str
    digest: str

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> ImagePair: ...

    def __iter__(self) -> Iterator[ImagePair]:
        return (self[index] for index in range(len(self)))


@runtime_checkable
class DepthDataset(PairDataset, Protocol):
    """A data set that knows how far away the points of its images are, in the unit of the pairs' t."""

    def depth(self, image: ImageSource, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth (n,) along the optical axis at points (n, 2) in pixels; NaN where it is unknown."""
        ...
