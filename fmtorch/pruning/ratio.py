"""Lowe's ratio test."""

from __future__ import annotations

import dataclasses
from typing import Annotated

from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.options import Within
from fmtorch.core.types import Correspondences


def ratio_test(
    quality: Float[Tensor, "b n"], threshold: float = 0.8, mask: Bool[Tensor, "b n"] | None = None
) -> Bool[Tensor, "b n"]:
    """True where the ratio of the distances to the nearest and second nearest descriptor is below `threshold`.

    The ratio is of Euclidean, not squared, distances; a ratio that is NaN fails. Lowe, IJCV 2004, section 7.1.
    """
    kept = quality < threshold
    return kept if mask is None else kept & mask


@dataclasses.dataclass(frozen=True)
class RatioTest:
    """`ratio_test` as a stage. Raises ValueError for correspondences without `quality`."""

    threshold: Annotated[float, Within(0)] = 0.8

    def __call__(self, correspondences: Correspondences) -> Correspondences:
        """The same matches, of which only distinctive ones survive."""
        if correspondences.quality is None:
            raise ValueError("the ratio test needs `quality`: the nearest-neighbour distance ratio of each match")
        return correspondences.keep(ratio_test(correspondences.quality, self.threshold))
