"""The nearest-neighbour matcher: Features x Features -> Correspondences."""

import dataclasses

import torch
from jaxtyping import Int
from torch import Tensor

from fmtorch.core.types import Correspondences, Features
from fmtorch.matching.nearest import nearest_neighbors


@dataclasses.dataclass(frozen=True)
class NearestNeighborMatcher:
    """Matches every feature of image 0 with the feature of image 1 whose descriptor is nearest (Euclidean).

    The slots of the result are the features of image 0, in their order; `mask` is True for those that found a
    partner. `ratio` is the ratio of the distances to the nearest and the second nearest descriptor, in [0, 1], and
    1 where it means nothing (a single candidate, two identical candidates).

    mutual: keep only matches whose partner's own nearest neighbour is the feature itself. It costs nothing, both
    directions being found in one pass; without it the result says which matches these are (`Correspondences.mutual`).
    chunk: rows of the distance matrix that exist at a time; changes speed and memory only.
    """

    mutual: bool = False
    chunk: int = 64

    def __call__(self, features0: Features, features1: Features) -> Correspondences:
        """The matches of one pair (a batch of one), or of a batch of pairs when the features have a leading dimension.

        Raises ValueError when the two batches or descriptor lengths differ.
        """
        shape0, shape1 = features0.descriptors.shape, features1.descriptors.shape
        if shape0[:-2] != shape1[:-2] or shape0[-1] != shape1[-1]:
            both = f"{tuple(shape0)} and {tuple(shape1)}"
            raise ValueError(f"descriptors {both} do not fit: batch and length must be the same")
        if len(shape0) == 2:
            names = [field.name for field in dataclasses.fields(Features)]
            features0, features1 = (
                f.replace(**{n: getattr(f, n)[None] for n in names}) for f in (features0, features1)
            )
        neighbors = nearest_neighbors(
            features0.descriptors, features1.descriptors, features0.valid, features1.valid, chunk=self.chunk
        )
        mask, lafs0, lafs1 = neighbors.nearest >= 0, features0.lafs, _take(features1.lafs, neighbors.nearest)
        frames = {"lafs0": lafs0, "lafs1": lafs1, "size0": features0.image_size, "size1": features1.image_size}
        known = {"ratio": neighbors.ratio.to(lafs0.dtype), "mutual": neighbors.mutual & mask}
        kept = mask & neighbors.mutual if self.mutual else mask
        return Correspondences(features0.keypoints, lafs1[..., 2], kept, **frames, **known)


def _take(lafs: Tensor, index: Int[Tensor, "b n0"]) -> Tensor:
    if lafs.shape[1] == 0:
        return lafs.new_zeros(*index.shape, 2, 3)
    taken = lafs.gather(1, index.clamp(min=0)[..., None, None].expand(-1, -1, 2, 3))
    return torch.where(index[..., None, None] >= 0, taken, 0.0)
