"""Learning to find good correspondences (Yi et al., CVPR 2018)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.core.types import Correspondences
from fmtorch.pruning.networks.inputs import MatchInputs
from fmtorch.pruning.networks.layers import Perceptron, ResidualBlock, Slots
from fmtorch.pruning.networks.learned import Backbone, Prediction


class PointCN(nn.Module):
    """The same perceptrons for every match, which see the others by context norm.

    A perceptron, residual blocks of two layers each, and a perceptron to the outputs.

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


class LC(nn.Module):
    """Classifies all matches of a pair at once.

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
        self.options = {"channels": channels, "blocks": blocks, "coordinates": coordinates, "side": list(side)}
        self.input_channels = self.inputs.channels
        self.backbone = PointCN(self.input_channels, channels, blocks)

    def extra_repr(self) -> str:
        """The options, which the run's identity holds."""
        return ", ".join(f"{key}={value}" for key, value in self.options.items())

    def forward(self, c: Correspondences) -> Prediction:
        """One stage; ``weight = tanh(relu(logit))`` as published (section 3.3), 0 where masked.

        Raises ValueError where image sizes or calibration matrices are missing.
        """
        return self.predict(c, self.backbone)

    def predict(self, c: Correspondences, backbone: Backbone) -> Prediction:
        """`forward` with something else that computes what `backbone` does, e.g. an ONNX file."""
        x, mask = self.inputs(c)
        logit = backbone(x, Slots.of(mask))[:, 0]
        weight = torch.where(mask, torch.tanh(torch.relu(logit)), 0)
        return Prediction(logit[None], weight[None])
