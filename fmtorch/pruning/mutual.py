"""The mutual-nearest-neighbour check: on index lists, and as a stage."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from fmtorch.core.types import Correspondences


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
