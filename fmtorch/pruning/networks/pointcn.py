"""The network of Yi et al. (CVPR 2018): the same perceptrons for every match, which see the others by context norm."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.pruning.networks.layers import Perceptron, ResidualBlock, Slots


class PointCN(nn.Module):
    """A perceptron, residual blocks of two layers each, and a perceptron to the outputs.

    Args:
        inputs: numbers for each match.
        channels: of each layer.
        blocks: how many.
        outputs: numbers for each match.
    """

    def __init__(self, inputs: int, channels: int, blocks: int, outputs: int = 1) -> None:
        super().__init__()
        self.p_in = Perceptron(inputs, channels)
        self.blocks = nn.ModuleList(ResidualBlock(channels) for _ in range(blocks))
        self.p_out = Perceptron(channels, outputs)

    def forward(self, x: Float[Tensor, "b inputs n"], slots: Slots) -> Float[Tensor, "b outputs n"]:
        """x has to be zero in masked slots, where the result means nothing."""
        y = slots.clean(torch.relu(self.p_in(x.transpose(0, 1))))
        for block in self.blocks:
            y = block(y, slots)
        return self.p_out(y).transpose(0, 1)  # type: ignore[no-any-return]
