"""What travels between the stages: `Features`, `Correspondences`, `Estimate`.

Conventions (the whole project's):
points are (x, y) in pixels with (0, 0) at the centre of the first pixel; sizes are (h, w); image 0 comes first and
``x1^T F x0 = 0``; ``mask`` is True for a real, surviving match, and what stands in a masked slot means nothing.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar, cast

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch.core.estimate import RELATED as RELATED
from fmtorch.core.estimate import Estimate as Estimate
from fmtorch.core.records import Index, Record, as_index, expect_fields, gathered, padded, slotted
from fmtorch.core.rules import DEVIATION, FOCAL, PROBABILITY, SIZE


def pair_key(identity: str) -> int:
    """The stable signed 64-bit key of a pair's identity (blake2b), which selects its random streams."""
    return int.from_bytes(hashlib.blake2b(identity.encode(), digest_size=8).digest(), "big", signed=True)


@dataclasses.dataclass(frozen=True, eq=False)
class Features(Record):
    """The local features of one image, or of a padded batch of images (a leading dimension on every field).

    lafs: local affine frames (N, 2, 3) in kornia's convention, the last column being the centre in pixels.
    scores: detector response (N,). descriptors: (N, D). image_size: (h, w).
    mask: (N,), True for a real feature; all True when not given.
    """

    lafs: Float[Tensor, "*batch n 2 3"]
    scores: Float[Tensor, "*batch n"]
    descriptors: Float[Tensor, "*batch n d"]
    image_size: Int[Tensor, "*batch 2"]
    mask: Bool[Tensor, "*batch n"] | None = None

    def __post_init__(self) -> None:
        expect_fields(self)
        if self.mask is None:
            mask = torch.ones(self.lafs.shape[:-2], dtype=torch.bool, device=self.lafs.device)
            object.__setattr__(self, "mask", mask)

    @property
    def keypoints(self) -> Float[Tensor, "*batch n 2"]:
        """The centres of the frames, (x, y) in pixels."""
        return self.lafs[..., 2]

    @property
    def valid(self) -> Bool[Tensor, "*batch n"]:
        """The mask, never None."""
        return cast(Tensor, self.mask)

    def __len__(self) -> int:
        """Number of feature slots, padding included."""
        return int(self.lafs.shape[-3])

    def __getitem__(self, index: Index) -> Features:
        """Of a batch, the selected images (still a batch); of one image, the selected features."""
        i = as_index(index, self.lafs.shape[0])
        size = self.image_size[i] if self.image_size.dim() > 1 else self.image_size
        return Features(self.lafs[i], self.scores[i], self.descriptors[i], size, self.valid[i])


@dataclasses.dataclass(frozen=True, eq=False)
class Correspondences(Record):
    """A batch of B image pairs with their putative matches, padded to N slots.

    x0, x1: matched points (B, N, 2) in pixels. mask: (B, N).
    quality: the matcher's own figure (B, N), for nearest neighbours the distance ratio; smaller is better.
    prior: P(inlier) in [0, 1], (B, N), where something supplies it. noise: standard deviation of each match's distance
    to its epipolar line, relative to that of a usual match, (B, N), where something supplies it.
    lafs0, lafs1: local affine frames (B, N, 2, 3) where known. size0, size1: image sizes (B, 2) as (h, w).
    K0, K1: calibration matrices (B, 3, 3) where known. key: (B,) int64, see `pair_key`; 0 when not given.
    mutual: (B, N), True where the match is also the best one of its partner, where the matcher knows.
    focal: what estimators may take for known of the focal lengths of both images, (B, 2, 2): px and relative standard
    deviation (0 exact, infinite unknown), for square pixels and central principal points. shared_focal: (B,), whether
    both are one in units of the longer sides. Without these estimates are of F alone, whatever K0 and K1 are.
    """

    x0: Float[Tensor, "b n 2"]
    x1: Float[Tensor, "b n 2"]
    mask: Bool[Tensor, "b n"]
    quality: Float[Tensor, "b n"] | None = None
    prior: Annotated[Float[Tensor, "b n"], PROBABILITY] | None = None
    lafs0: Float[Tensor, "b n 2 3"] | None = None
    lafs1: Float[Tensor, "b n 2 3"] | None = None
    size0: Annotated[Real[Tensor, "b 2"], SIZE] | None = None
    size1: Annotated[Real[Tensor, "b 2"], SIZE] | None = None
    K0: Float[Tensor, "b 3 3"] | None = None
    K1: Float[Tensor, "b 3 3"] | None = None
    key: Int[Tensor, " b"] | None = None
    mutual: Bool[Tensor, "b n"] | None = None
    noise: Annotated[Float[Tensor, "b n"], DEVIATION] | None = None
    focal: Annotated[Float[Tensor, "b 2 2"], FOCAL] | None = None
    shared_focal: Bool[Tensor, " b"] | None = None

    def __post_init__(self) -> None:
        expect_fields(self)
        if self.key is None:
            object.__setattr__(self, "key", torch.zeros(len(self), dtype=torch.int64, device=self.x0.device))
        if (self.size0 is None) != (self.size1 is None):
            known, missing = ("size1", "size0") if self.size0 is None else ("size0", "size1")
            raise ValueError(f"{known} is given but {missing} is not; give the sizes of both images, or of neither")

    @property
    def keys(self) -> Int[Tensor, " b"]:
        """The pairs' keys, never None."""
        return cast(Tensor, self.key)

    @property
    def asks_for_cameras(self) -> bool:
        """Whether estimates have focal lengths."""
        return self.focal is not None or self.shared_focal is not None

    def __len__(self) -> int:
        """Number of pairs."""
        return int(self.x0.shape[0])

    def __getitem__(self, index: Index) -> Correspondences:
        """The selected pairs, always as a batch."""
        i = as_index(index, len(self))
        return self._map(lambda value: value[i])

    def count(self) -> Int[Tensor, " b"]:
        """Number of surviving matches of each pair."""
        return self.mask.sum(-1)

    def keep(self, mask: Bool[Tensor, "b n"]) -> Correspondences:
        """The same matches, of which only those also in `mask` survive."""
        return self.replace(mask=self.mask & mask)

    def compact(self, multiple: int = 1) -> Correspondences:
        """Survivors moved to the front in their order, padding cut to the longest pair (rounded up to `multiple`)."""
        longest = int(self.count().max()) if self.mask.numel() else 0
        n = -(-longest // multiple) * multiple
        order = torch.argsort(self.mask.logical_not().to(torch.uint8), dim=-1, stable=True)[:, :n]
        return self.derived(**{name: padded(gathered(v, order), 1, n) for name, v in slotted(self).items()})


Item = TypeVar("Item", Features, Correspondences, Estimate)


def collate(items: Sequence[Item]) -> Item:
    """One padded batch from several items: single-image `Features` are stacked, batches are joined.

    Optional fields survive only where every item has them. Raises ValueError for an empty list, TypeError for items of
    several kinds (single images and batches of images are two kinds).
    """
    if not items:
        raise ValueError("collate needs at least one item")
    first = items[0]
    if len({(type(item), item.lafs.dim() if isinstance(item, Features) else 0) for item in items}) > 1:
        raise TypeError(f"collate needs items of one kind, not {', '.join(type(item).__name__ for item in items[:5])}")
    n = max(_slots(item) for item in items)
    single = isinstance(first, Features) and first.image_size.dim() == 1
    merged: dict[str, Any] = {}
    for field in dataclasses.fields(first):
        values = [getattr(item, field.name) for item in items]
        if field.name == "reason":
            merged[field.name] = sum(values, ())
        elif field.name == "model":
            if len(set(values)) > 1:
                raise TypeError(f"collate needs estimates of one model, not {', '.join(sorted(set(values)))}")
            merged[field.name] = values[0]
        elif any(value is None for value in values):
            merged[field.name] = None
        else:
            filled = (
                [padded(value, 0 if single else 1, n) for value in values] if field.name in first.per_slot else values
            )
            merged[field.name] = torch.stack(filled) if single else torch.cat(filled)
    return type(first)(**merged)


def _slots(item: Features | Correspondences | Estimate) -> int:
    if isinstance(item, Features):
        return len(item)
    return int((item.x0 if isinstance(item, Correspondences) else item.inliers).shape[1])
