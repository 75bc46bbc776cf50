"""One match per keypoint location in each image."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.compiling.batches import for_each_pair, kernels_serve
from fmtorch.core.types import Correspondences
from fmtorch.pruning import one_to_one_kernels as compiled


def one_to_one(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    quality: Float[Tensor, "b n"],
    mask: Bool[Tensor, "b n"] | None = None,
) -> Bool[Tensor, "b n"]:
    """True for a match that is the best one at its location in image 0 and the best one at its location in image 1.

    The best has the lowest `quality` (NaN is worst), ties by lowest index. Locations are the same when the coordinates
    are exactly equal, as those of one keypoint with several orientations are. The rule is symmetric in the images and
    independent of the order of the matches, ties apart. Matches with a non-finite coordinate are dropped.
    O(N log N), on a CPU O(N).
    """
    if kernels_serve(x0.detach(), x1.detach(), quality.detach()):
        tensors = (x0, x1, quality, torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask)
        out = torch.empty(x0.shape[:2], dtype=torch.bool)
        return for_each_pair(compiled.one_to_one, tensors, out=out, kind=torch.float64)
    finite = torch.isfinite(x0).all(-1) & torch.isfinite(x1).all(-1)
    mask = finite if mask is None else finite & mask
    rank = torch.where(mask & ~quality.isnan(), quality, torch.inf)
    return mask & _best_at_location(x0, rank, mask) & _best_at_location(x1, rank, mask)


def _best_at_location(x: Tensor, rank: Tensor, mask: Tensor) -> Tensor:
    """True for the first match of every location, in the lexicographic order of (x, y, rank, index)."""
    x = torch.where(mask[..., None], x, torch.inf)
    order = torch.argsort(rank, dim=-1, stable=True)
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
