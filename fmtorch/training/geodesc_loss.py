"""GeoDesc's loss on the descriptors of match sets (Luo et al., ECCV 2018, arXiv 1807.06294, section 3.5).

The authors' released training code (lzx551402/tfmatch) has another loss, so that no implementation of theirs stands
beside this one.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

MARGINS = ((0.5, 0.7), (0.2, 0.5), (0.0, 0.2))
"""Of the geometric loss: from this S_patch on, the cosine similarity that a match should reach."""


def structured(a: Float[Tensor, "*s n d"], b: Float[Tensor, "*s n d"], *, ratio: float = 0.4) -> Float[Tensor, ""]:
    """The structured loss E_1 of match sets, the mean over the sets.

    With S = A B^T and L = S - ratio diag(S), the sum over i and j of max(0, l_ij - l_ii) + max(0, l_ij - l_jj) by
    n (n - 1): no patch of the other photograph should be as similar as 1 - `ratio` of its own match. All of them count,
    not the hardest alone.

    Args:
        a, b: unit descriptors of the n >= 2 matches of each set; row i of both is the same point.
        ratio: alpha, in (0, 1).
    """
    similarity = a @ b.mT
    own = (1 - ratio) * similarity.diagonal(dim1=-2, dim2=-1)
    n = similarity.shape[-1]
    other = ~torch.eye(n, dtype=torch.bool, device=similarity.device)
    hinges = (similarity - own[..., :, None]).clamp_min(0) + (similarity - own[..., None, :]).clamp_min(0)
    return torch.where(other, hinges, 0.0).sum((-2, -1)).mean() / (n * (n - 1))


def geometric(
    a: Float[Tensor, "*s n d"], b: Float[Tensor, "*s n d"], similarity: Float[Tensor, "*s n"]
) -> Float[Tensor, ""]:
    """The geometric loss E_2: max(0, margin - cosine similarity) of each match, the mean.

    The margin is 0.7 where S_patch >= 0.5, 0.5 where it is >= 0.2 and else 0.2: patches that geometry makes hard to
    match need not be as similar. The mean in place of the sum keeps the weight of the loss independent of n.

    Args:
        a, b: unit descriptors. similarity: S_patch of each match, in [0, 1].
    """
    return (margins(similarity) - (a * b).sum(-1)).clamp_min(0).mean()


def margins(similarity: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """The margin of the geometric loss for each S_patch."""
    margin = torch.zeros_like(similarity)
    for threshold, value in reversed(MARGINS):
        margin = torch.where(similarity >= threshold, value, margin)
    return margin


def geodesc(
    a: Float[Tensor, "*s n d"], b: Float[Tensor, "*s n d"], similarity: Float[Tensor, "*s n"],
    *, ratio: float = 0.4, geometric_weight: float = 0.2,
) -> Float[Tensor, ""]:  # fmt: skip
    """GeoDesc's loss E_1 + lambda E_2: `structured` plus `geometric_weight` times `geometric`."""
    return structured(a, b, ratio=ratio) + geometric_weight * geometric(a, b, similarity)
