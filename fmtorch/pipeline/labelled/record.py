"""`LabelledMatches`: correspondences of a batch of pairs, which of them are right, and the true geometry."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from fmtorch.core import types
from fmtorch.core.records import Index, Record, as_index, expect_fields, gathered, slotted
from fmtorch.core.types import Correspondences
from fmtorch.pipeline.labelled.labels import IGNORED, INLIER


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
        """True for the matches that a loss may look at: real ones that are inliers or outliers."""
        return self.label >= 0

    @property
    def inlier(self) -> Bool[Tensor, "b n"]:
        """True for the matches that are right."""
        return self.label == INLIER

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.correspondences)

    def __getitem__(self, index: Index) -> LabelledMatches:
        """The selected pairs, always as a batch."""
        i = as_index(index, len(self))
        return self._map(lambda value: value[i])

    def keep(self, mask: Bool[Tensor, "b n"]) -> LabelledMatches:
        """The same matches, of which only those also in `mask` survive."""
        return self.replace(correspondences=self.correspondences.keep(mask))

    def compact(self, multiple: int = 1) -> LabelledMatches:
        """Matches moved to the front in their order, padding cut to the longest pair (rounded up to `multiple`)."""
        mask = self.correspondences.mask
        order = torch.argsort(mask.logical_not().to(torch.uint8), dim=-1, stable=True)
        longest = int(mask.sum(-1).max()) if mask.numel() else 0
        n = -(-longest // multiple) * multiple
        moved = self.reorder(order[:, :n])
        if moved.label.shape[1] == n:
            return moved
        return dataclasses.replace(
            moved, correspondences=moved.correspondences.compact(multiple), label=_padded(moved.label, n)
        )

    def reorder(self, order: Int[Tensor, "b m"]) -> LabelledMatches:
        """The matches in the slots `order` of each pair, in that order."""
        moved = {name: gathered(value, order) for name, value in slotted(self.correspondences).items()}
        return LabelledMatches(self.correspondences.replace(**moved), gathered(self.label, order), self.F)

    def first(self, count: int) -> LabelledMatches:
        """The first `count` slots of each pair."""
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
    """Labels of `n` slots, ignored beyond the given ones."""
    missing = max(n - label.shape[1], 0)
    return torch.nn.functional.pad(label, (0, missing), value=IGNORED)[:, :n]
