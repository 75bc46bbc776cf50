"""What a learned pruner says of a batch of pairs, and what it has to be made of to run without torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.core.types import Correspondences
from fmtorch.pruning.networks.layers import Slots

Backbone = Callable[[Tensor, Slots], Tensor]  # (B, channels, N), zero in masked slots -> (B, outputs, N)


class Prediction(NamedTuple):
    """The output of a network over S stages (one, or one for each iteration); the last stage counts.

    logit: log-odds that a match is an inlier, (S, B, N); finite and without meaning in masked slots.
    weight: of the match in a weighted 8-point fit, (S, B, N); not negative, 0 where masked.
    F: fundamental matrices that the network fits itself, (S, B, 3, 3), float64, in pixels and of unit Frobenius norm;
    where a fit is not determined the one of the stage before, or zero; None where the network fits none.
    """

    logit: Float[Tensor, "stages b n"]
    weight: Float[Tensor, "stages b n"]
    F: Float[Tensor, "stages b 3 3"] | None = None


@runtime_checkable
class Exportable(Protocol):
    """A network whose parameters all belong to its `backbone`, a function of tensors: ONNX Runtime can take its place.

    input_channels: of the backbone. options: the arguments that build the network, which its files state.
    """

    backbone: Any
    input_channels: int
    options: Mapping[str, Any]

    def predict(self, c: Correspondences, backbone: Backbone) -> Prediction:
        """The prediction, with `backbone` or what takes its place."""
        ...


def predict(network: nn.Module, c: Correspondences) -> Prediction:
    """What any network says of a batch: one that returns log-odds (B, N) alone gets weights of ``tanh(relu(logit))``.

    Raises TypeError or ValueError where the network returns something else.
    """
    output = network(c)
    if isinstance(output, Prediction):
        return output
    if not isinstance(output, Tensor):
        kind = type(output).__name__
        raise TypeError(f"{type(network).__name__} returns {kind}; a network of matches returns log-odds or Prediction")
    if output.shape != c.mask.shape:
        raise ValueError(
            f"{type(network).__name__} returns log-odds of shape {tuple(output.shape)} for matches of shape "
            f"{tuple(c.mask.shape)}; there must be one for each match"
        )
    return Prediction(output[None], torch.where(c.mask, torch.tanh(torch.relu(output)), 0)[None])
