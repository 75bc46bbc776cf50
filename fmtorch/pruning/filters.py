"""Lowe's ratio test."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.core.options import Within
from fmtorch.core.types import Correspondences


def ratio_test(
    ratio: Float[Tensor, "b n"], threshold: float = 0.8, mask: Bool[Tensor, "b n"] | None = None
) -> Bool[Tensor, "b n"]:
    """True where the ratio of the distances to the nearest and second nearest descriptor is below `threshold`.

    The ratio is of Euclidean, not squared, distances; a ratio that is NaN fails. Lowe, IJCV 2004, section 7.1.
    """
    kept = ratio < threshold
    return kept if mask is None else kept & mask


@dataclasses.dataclass(frozen=True)
class RatioTest:
    """`ratio_test` of the ratios, or of 1 - score, as a stage. Raises ValueError where matches have neither."""

    threshold: Annotated[float, Within(0)] = 0.8

    def __call__(self, correspondences: Correspondences) -> Correspondences:
        """The same matches, of which only distinctive ones survive."""
        ambiguity = correspondences.ambiguity
        if ambiguity is None:
            raise ValueError(
                "the ratio test needs `ratio`, the nearest-neighbour distance ratio of each match, or `score`"
            )
        return correspondences.keep(ratio_test(ambiguity, self.threshold))


# The mutual-nearest-neighbour check: on index lists, and as a stage


def mutual(
    index: Int[Tensor, "b n0"], reverse: Int[Tensor, "b n1"], mask: Bool[Tensor, "b n0"] | None = None
) -> Bool[Tensor, "b n0"]:
    """True for a feature i of image 0 whose match j = index[i] is matched back to it, reverse[j] = i.

    Negative entries are features without a match. Raises ValueError for a feature of image 1 that there is not.
    """
    if reverse.shape[-1] == 0:
        return torch.zeros_like(index, dtype=torch.bool)
    matched = index >= 0 if mask is None else (index >= 0) & mask
    if bool((matched & (index >= reverse.shape[-1])).any()):
        raise ValueError(f"index holds {int(index.max())}, but reverse has {reverse.shape[-1]} features only")
    back = reverse.gather(-1, torch.where(matched, index, 0))
    return matched & (back == torch.arange(index.shape[-1], device=index.device))


class MutualCheck:
    """Matches survive that are the best ones of both features. Raises ValueError where the matcher did not tell."""

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only mutual ones survive."""
        if c.mutual is None:
            raise ValueError("the mutual check needs `mutual`, which a matcher of both directions supplies")
        return c.keep(c.mutual)


# One match per keypoint location in each image


def one_to_one(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    ambiguity: Float[Tensor, "b n"],
    mask: Bool[Tensor, "b n"] | None = None,
) -> Bool[Tensor, "b n"]:
    """True for a match that is the best one at its location in image 0 and the best one at its location in image 1.

    The best has the lowest `ambiguity` (NaN is worst), ties by lowest index. Locations are the same when coordinates
    are exactly equal, as those of one keypoint with several orientations are. The rule is symmetric in the images and
    independent of the order of the matches, ties apart. Matches with a non-finite coordinate are dropped. O(N log N).
    """
    finite = torch.isfinite(x0).all(-1) & torch.isfinite(x1).all(-1)
    mask = finite if mask is None else finite & mask
    rank = torch.where(mask & ~ambiguity.isnan(), ambiguity, torch.inf)
    order = torch.argsort(rank, dim=-1, stable=True)
    return mask & _first_at_location(x0, order, mask) & _first_at_location(x1, order, mask)


def _first_at_location(x: Tensor, order: Tensor, mask: Tensor) -> Tensor:
    """True for the match of every location that comes first in an order."""
    x = torch.where(mask[..., None], x, torch.inf)
    for column in (x[..., 1], x[..., 0]):
        order = order.gather(-1, torch.argsort(column.gather(-1, order), dim=-1, stable=True))
    location = x.gather(1, order[..., None].expand(-1, -1, 2))
    first = torch.ones_like(mask)
    first[:, 1:] = (location[:, 1:] != location[:, :-1]).any(-1)
    return torch.zeros_like(mask).scatter(-1, order, first)


@dataclasses.dataclass(frozen=True)
class OneToOne:
    """`one_to_one` as a stage. Raises ValueError for correspondences with neither `ratio` nor `score`."""

    def __call__(self, correspondences: Correspondences) -> Correspondences:
        """The same matches, of which at most one survives at each location of each image."""
        c = correspondences
        ambiguity = c.ambiguity
        if ambiguity is None:
            raise ValueError("one-to-one needs `ratio` or `score`, by which the best match of a location is chosen")
        return c.keep(one_to_one(c.x0, c.x1, ambiguity, c.mask))


# Keeping the matches that are likely to be right


@dataclasses.dataclass(frozen=True)
class Likely:
    """Keeps the matches whose ``prior``, P(inlier), is at least `min_probability`.

    It makes a filter of any stage that supplies a prior. Raises ValueError for correspondences without a prior.
    """

    min_probability: float = 0.5

    def __call__(self, correspondences: Correspondences) -> Correspondences:
        """The same matches, of which only likely ones survive; a prior that is NaN fails."""
        if correspondences.prior is None:
            raise ValueError("`likely` needs `prior`: put a stage that supplies it before, e.g. frame_consistency")
        return correspondences.keep(correspondences.prior >= self.min_probability)
