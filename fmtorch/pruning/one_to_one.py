"""One match per keypoint location in each image."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.types import Correspondences


def one_to_one(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    quality: Float[Tensor, "b n"],
    mask: Bool[Tensor, "b n"] | None = None,
) -> Bool[Tensor, "b n"]:
    """True for a match that is the best one at its location in image 0 and the best one at its location in image 1.

    The best has the lowest `quality` (NaN is worst), ties by lowest index. Locations are the same when the coordinates
    are exactly equal, as those of one keypoint with several orientations are. The rule is symmetric in the images and
    independent of the order of the matches, ties apart. Matches with a non-finite coordinate are dropped. O(N log N).
    """
    finite = torch.isfinite(x0).all(-1) & torch.isfinite(x1).all(-1)
    mask = finite if mask is None else finite & mask
    rank = torch.where(mask & ~quality.isnan(), quality, torch.inf)
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
    """`one_to_one` as a stage. Raises ValueError for correspondences without `quality`."""

    def __call__(self, correspondences: Correspondences) -> Correspondences:
        """The same matches, of which at most one survives at each location of each image."""
        c = correspondences
        if c.quality is None:
            raise ValueError("one-to-one needs `quality`: the figure by which the best match of a location is chosen")
        return c.keep(one_to_one(c.x0, c.x1, c.quality, c.mask))
