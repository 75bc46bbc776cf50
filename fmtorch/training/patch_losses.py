"""Losses for patch networks, on two descriptors of each point: row i of both is the same point."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

SAME_PATCH = 0.008
"""A negative nearer than this is taken for the same patch twice, as in the authors' code for HardNet."""


def distances(a: Float[Tensor, "n d"], b: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """Euclidean distances of unit vectors; the gradient stays finite where they coincide."""
    return (2 - 2 * a @ b.mT).clamp_min(1e-6).sqrt()


def positive_and_hardest_negative(
    a: Float[Tensor, "n d"], b: Float[Tensor, "n d"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Distance of each pair, and that of the hardest negative in the batch for either of its ends (anchor swap)."""
    d = distances(a, b)
    excluded = torch.eye(len(d), dtype=torch.bool, device=d.device) | (d < SAME_PATCH)
    negative = torch.where(excluded, 10.0, d)
    return d.diagonal(), torch.minimum(negative.min(1).values, negative.min(0).values)


def hardest_triplet(
    a: Float[Tensor, "n d"], b: Float[Tensor, "n d"], *, margin: float = 1.0, squared: bool = False
) -> Float[Tensor, ""]:
    """HardNet's loss (Mishchuk et al., NIPS 2017, eq. 4): max(0, margin + positive - hardest negative), the mean.

    squared: the hinge squared, which presses less on triplets that are nearly right.
    """
    positive, negative = positive_and_hardest_negative(a, b)
    hinge = (margin + positive - negative).clamp_min(0)
    return (hinge.square() if squared else hinge).mean()


def hard_negative_constant(
    a: Float[Tensor, "n d"], b: Float[Tensor, "n d"], *, margin: float = 1.0
) -> Float[Tensor, ""]:
    """AffNet's loss (Mishkin et al., ECCV 2018, eq. 5): HardNet's, with the negative distance a constant.

    A negative only chooses the weight of its pair; it does not push shapes away from each other.
    """
    positive, negative = positive_and_hardest_negative(a, b)
    return (margin + positive - negative.detach()).clamp_min(0).mean()


def relative_distance(
    a: Float[Tensor, "n d"], b: Float[Tensor, "n d"], *, compactness: float = 1.0
) -> Float[Tensor, ""]:
    """L2-Net's loss (Tian, Fan, Wu, CVPR 2017, eq. 5 and 9), without its term on intermediate feature maps.

    Minus the log of the positive's share of exp(2 - distance) in its row and its column, the mean over the batch; plus
    `compactness` times half the sum of squared correlations between dimensions of the descriptor, divided by their
    number so that it does not outgrow the first term.
    """
    similarity = 2 - distances(a, b)
    rows, columns = similarity.log_softmax(1).diagonal(), similarity.log_softmax(0).diagonal()
    return -(rows + columns).mean() / 2 + compactness * (_correlation(a) + _correlation(b)) / 2


def _correlation(x: Float[Tensor, "n d"]) -> Float[Tensor, ""]:
    """Half the sum of squared correlations between different columns, by the number of columns."""
    centred = x - x.mean(0)
    centred = centred / (centred.square().sum(0) + 1e-10).sqrt()
    r = centred.mT @ centred
    return (r.square().sum() - r.diagonal().square().sum()) / (2 * x.shape[1])


LOSS_CODES = {"hardest_triplet": hardest_triplet, "relative_distance": relative_distance}
