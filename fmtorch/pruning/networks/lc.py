"""Learning to find good correspondences (Yi et al., CVPR 2018)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.pruning.networks.inputs import MatchInputs
from fmtorch.pruning.networks.layers import Perceptron, ResidualBlock, Slots
from fmtorch.pruning.networks.prediction import Prediction
from fmtorch.types import Correspondences


class LC(nn.Module):
    """PointCN: the same perceptrons for every match, which see the others through context normalisation.

    Yi, Trulls, Ono, Lepetit, Salzmann, Fua, "Learning to find good correspondences", CVPR 2018.

    Args:
        channels: of each layer.
        blocks: residual blocks of two layers.
        coordinates: "size", for the fundamental matrix, or "K", for the essential matrix as published.
        side: side information, see `MatchInputs`.

    Raises:
        ValueError: for unknown coordinates or side information.
    """

    def __init__(
        self, *, channels: int = 128, blocks: int = 12, coordinates: str = "size", side: Sequence[str] = ()
    ) -> None:
        super().__init__()
        self.inputs = MatchInputs(coordinates, tuple(side))
        self.p_in = Perceptron(self.inputs.channels, channels)
        self.blocks = nn.ModuleList(ResidualBlock(channels) for _ in range(blocks))
        self.p_out = Perceptron(channels, 1)

    @property
    def options(self) -> dict[str, object]:
        """The arguments that build this network, as plain values."""
        return {
            "channels": self.p_in.weight.shape[0], "blocks": len(self.blocks),
            "coordinates": self.inputs.coordinates, "side": list(self.inputs.side),
        }  # fmt: skip

    def forward(self, c: Correspondences) -> Prediction:
        """One stage; ``weight = tanh(relu(logit))`` as published (section 3.3), 0 where masked.

        Raises ValueError where image sizes or calibration matrices are missing.
        """
        x, mask = self.inputs(c)
        logit = self.logit(x, Slots.of(mask))
        weight = torch.where(mask, torch.tanh(torch.relu(logit)), 0)
        return Prediction(logit[None], weight[None])

    def logit(self, x: Float[Tensor, "b channels n"], slots: Slots) -> Float[Tensor, "b n"]:
        """Log-odds of each match from its `inputs`, which are zero in masked slots."""
        y = slots.clean(torch.relu(self.p_in(x.transpose(0, 1))))
        for block in self.blocks:
            y = block(y, slots)
        return self.p_out(y)[0]  # type: ignore[no-any-return]
