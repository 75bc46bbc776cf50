"""What a learned pruner says of a batch of pairs."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor


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
