"""The mutual-nearest-neighbour check on index lists."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int
from torch import Tensor


def mutual(
    index: Int[Tensor, "b n0"], reverse: Int[Tensor, "b n1"], mask: Bool[Tensor, "b n0"] | None = None
) -> Bool[Tensor, "b n0"]:
    """True for a feature i of image 0 whose match j = index[i] is matched back to it, reverse[j] = i.

    Negative entries are features without a match. `Correspondences` hold the matches of one direction only, so the
    pipeline's check is the matcher's option ``mutual``; this function serves whoever holds both lists.
    """
    if reverse.shape[-1] == 0:
        return torch.zeros_like(index, dtype=torch.bool)
    matched = index >= 0 if mask is None else (index >= 0) & mask
    back = reverse.gather(-1, torch.where(matched, index, 0))
    return matched & (back == torch.arange(index.shape[-1], device=index.device))
