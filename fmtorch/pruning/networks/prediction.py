"""What a learned pruner says of a batch of pairs."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.types import Correspondences


class Prediction(NamedTuple):
    """The output of a network over S stages (one, or one for each iteration); the last stage counts.

    logit: log-odds that a match is an inlier, (S, B, N); finite and without meaning in masked slots.
    weight: of the match in a weighted 8-point fit, (S, B, N); not negative, 0 where masked.
    F: fundamental matrices that the network fits itself, (S, B, 3, 3), float64, in pixels and of unit Frobenius norm,
    zero where a fit is not determined; None where it fits none.
    """

    logit: Float[Tensor, "stages b n"]
    weight: Float[Tensor, "stages b n"]
    F: Float[Tensor, "stages b 3 3"] | None = None


def predict(network: nn.Module, c: Correspondences) -> Prediction:
    """What any network says of a batch: one that returns log-odds (B, N) alone gets weights of ``tanh(relu(logit))``.

    Raises TypeError or ValueError where the network returns something else.
    """
    output = network(c)
    if isinstance(output, Prediction):
        return output
    if not isinstance(output, Tensor):
        kind = type(output).__name__
        raise TypeError(f"{type(network).__name__} returns {kind}; a network of matches returns log-odds or a Prediction")
    if output.shape != c.mask.shape:
        raise ValueError(
            f"{type(network).__name__} returns log-odds of shape {tuple(output.shape)} for matches of shape "
            f"{tuple(c.mask.shape)}; there must be one for each match"
        )
    return Prediction(output[None], torch.where(c.mask, torch.tanh(torch.relu(output)), 0)[None])
