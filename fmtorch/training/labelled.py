"""`LabelledMatches`: correspondences of a batch of pairs, which of them are right, and the true geometry.

A match is right by where the true depth puts its point in the other image: an inlier where the point is carried to
within `INLIER_PX` of its partner, and an outlier where it is carried farther than `OUTLIER_PX` away, be it along the
epipolar line, where no estimator could tell. Between the two it is ignored: localisation of coarse keypoints is no
better. With a depth on both sides both directions must agree. Where no depth is known the distance to the epipolar
lines decides with the same two thresholds; it takes a wrong match that is near its line by chance for a right one (a
band of 6 px in an image 500 px high: about one in eighty).
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core import types
from fmtorch.core.records import Index, Record, as_index, expect_fields, gathered, slotted
from fmtorch.core.types import Correspondences
from fmtorch.data.cameras import line_distance
from fmtorch.data.pairs import DepthDataset, ImagePair, ImageSource, PairDataset

INLIER, OUTLIER, IGNORED = 1, 0, -1
INLIER_PX = 3.0  # largest error of an inlier, pixels
OUTLIER_PX = 6.0  # smallest error of an outlier, pixels
EDGE_PX = 1.0  # a keypoint on an edge of depth may belong to what is so many pixels beside it
VERSION = 1  # of these rules, part of a store's identity

Points = NDArray[np.float64]
Labels = NDArray[np.int8]
_AROUND = EDGE_PX * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


@dataclasses.dataclass(frozen=True, eq=False)
class LabelledMatches(Record):
    """A batch of B pairs with N matches each (padded), labels and the true fundamental matrices.

    correspondences: the matches. label: (B, N) int8, 1 inlier, 0 outlier, -1 ignored, always -1 in masked slots.
    F: (B, 3, 3) float64 of unit Frobenius norm, ``x1^T F x0 = 0``; zero where none is known or determined.
    """

    correspondences: Correspondences
    label: Int8[Tensor, "b n"]
    F: Float[Tensor, "b 3 3"]

    def __post_init__(self) -> None:
        b, n = self.correspondences.x0.shape[:2]
        expect_fields(self, b=b, n=n)
        label = torch.where(self.correspondences.mask, self.label, IGNORED)
        object.__setattr__(self, "label", label)

    @property
    def labelled(self) -> Bool[Tensor, "b n"]:
        return self.label >= 0

    @property
    def inlier(self) -> Bool[Tensor, "b n"]:
        return self.label == INLIER

    def __len__(self) -> int:
        return len(self.correspondences)

    def __getitem__(self, index: Index) -> "LabelledMatches":
        """The selected pairs, always as a batch."""
        i = as_index(index, len(self))
        return self._map(lambda value: value[i])

    def keep(self, mask: Bool[Tensor, "b n"]) -> "LabelledMatches":
        return self.replace(correspondences=self.correspondences.keep(mask))

    def compact(self, multiple: int = 1) -> "LabelledMatches":
        """Matches moved to the front in their order, padding cut to the longest pair (rounded up to `multiple`)."""
        c, mask = self.correspondences.compact(multiple), self.correspondences.mask
        n = c.x0.shape[1]
        order = torch.argsort(mask.logical_not().to(torch.uint8), dim=-1, stable=True)[:, :n]
        return LabelledMatches(c, _padded(gathered(self.label, order), n), self.F)

    def reorder(self, order: Int[Tensor, "b m"]) -> "LabelledMatches":
        """The matches in the slots `order` of each pair, in that order."""
        moved = {name: gathered(value, order) for name, value in slotted(self.correspondences).items()}
        return LabelledMatches(self.correspondences.replace(**moved), gathered(self.label, order), self.F)

    def first(self, count: int) -> "LabelledMatches":
        cut = {name: value[:, :count] for name, value in slotted(self.correspondences).items()}
        return LabelledMatches(self.correspondences.replace(**cut), self.label[:, :count], self.F)


def collate(items: Sequence[LabelledMatches]) -> LabelledMatches:
    """One padded batch from several: for torch's DataLoader. Optional fields survive only where every item has them.

    Raises ValueError for an empty list.
    """
    c = types.collate([item.correspondences for item in items])
    n = c.x0.shape[1]
    label = torch.cat([_padded(item.label, n) for item in items])
    return LabelledMatches(c, label, torch.cat([item.F for item in items]))


def _padded(label: Tensor, n: int) -> Tensor:
    missing = max(n - label.shape[1], 0)
    return torch.nn.functional.pad(label, (0, missing), value=IGNORED)[:, :n]


def label(dataset: PairDataset, pair: ImagePair, x0: Points, x1: Points) -> Labels:
    """Labels (n,) of the matches x0, x1 (n, 2) of a pair: by depth where the data set offers it and the pair's cameras
    are known, else by the epipolar lines.
    """
    cameras = (pair.K0, pair.K1, pair.R, pair.t)
    line = line_distance(pair.F, x0, x1)
    if not isinstance(dataset, DepthDataset) or any(value is None for value in cameras):
        return by_line(line)
    K0, K1, R, t = (np.asarray(value) for value in cameras)
    depth0, depth1 = (depths(dataset, image, x) for image, x in ((pair.image0, x0), (pair.image1, x1)))
    forward = transfer_error(x0, depth0, x1, K0, K1, R, t)
    backward = transfer_error(x1, depth1, x0, K1, K0, R.T, -R.T @ t)
    return by_transfer(forward, backward, line)


def by_line(line: NDArray[np.float64]) -> Labels:
    """Labels of matches whose larger distance (n,) to the epipolar lines, or other error, is given in pixels."""
    return np.select([line <= INLIER_PX, line > OUTLIER_PX], [INLIER, OUTLIER], IGNORED).astype(np.int8)


def by_transfer(forward: NDArray[np.float64], backward: NDArray[np.float64], line: NDArray[np.float64]) -> Labels:
    """Labels from the transfer errors (n,) in pixels either way, NaN where the depth is unknown, and `line`.

    Where neither depth is known (the sky) a match far from its line is an outlier, and one near it is ignored.
    """
    unknown = np.isnan(forward) & np.isnan(backward)
    labels = by_line(np.fmax(forward, backward))
    return np.where(unknown, np.where(line > OUTLIER_PX, OUTLIER, IGNORED), labels).astype(np.int8)


def depths(dataset: DepthDataset, image: ImageSource, x: Points) -> NDArray[np.float64]:
    """The depths (k, n) at points (n, 2) of an image and `EDGE_PX` beside them."""
    around = (x[None] + _AROUND[:, None]).reshape(-1, 2)
    return dataset.depth(image, around).reshape(len(_AROUND), -1)


def transfer_error(
    x: Points, depth: NDArray[np.float64], partner: Points, K: NDArray[np.float64], K_other: NDArray[np.float64],
    R: NDArray[np.float64], t: NDArray[np.float64],
) -> NDArray[np.float64]:  # fmt: skip
    """How far (n,), in pixels, points are carried past their partners in the other image, at the kindest of k depths.

    Args:
        x, partner: matched points (n, 2) in pixels. depth: candidates (k, n), NaN where unknown.
        K, K_other: calibration of the two images. R, t: ``X_other = R X + t``.

    Returns: NaN where no depth is known, infinity where a point would be behind the other camera.
    """
    rays = np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(K).T
    there = (depth[..., None] * rays @ R.T + t) @ K_other.T
    ahead = there[..., 2] > 0
    at = there[..., :2] / np.where(ahead, there[..., 2], 1.0)[..., None]
    error = np.where(ahead, np.hypot(*np.moveaxis(at - partner, -1, 0)), np.inf)
    kindest = np.where(np.isnan(depth), np.inf, error).min(0)
    return np.where(np.isnan(depth).all(0), np.nan, kindest)
