"""The networks: LC (Yi et al., CVPR 2018) and DFE (Ranftl & Koltun, ECCV 2018)."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from fmtorch.core.types import Correspondences
from fmtorch.geometry.irls import reweighted_fits
from fmtorch.pruning.networks.inputs import MatchInputs
from fmtorch.pruning.networks.layers import ContextBatchNormReLU, Perceptron, ResidualBlock, Slots
from fmtorch.pruning.networks.learned import Backbone, Prediction

RESIDUAL_UNIT = 1e-3  # of the image's longest side, or of the focal length: about a pixel
LARGEST_RESIDUAL = 0.5  # of the same; as published


class _OfBackbone(nn.Module):
    """A network of a `backbone`, with `options` that the run's identity holds."""

    options: dict[str, Any]

    def extra_repr(self) -> str:
        return ", ".join(f"{key}={value}" for key, value in self.options.items())

    def forward(self, c: Correspondences) -> Prediction:
        """The prediction of each match. Raises ValueError where image sizes or calibration matrices are missing."""
        return self.predict(c, self.backbone)  # type: ignore[no-any-return, operator]


class PointCN(nn.Module):
    """The same perceptrons for every match, which see the others by context norm.

    A perceptron, residual blocks of two layers each, and a perceptron to the outputs.
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


class LC(_OfBackbone):
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

    def predict(self, c: Correspondences, backbone: Backbone) -> Prediction:
        """One stage; ``weight = tanh(relu(logit))`` as published (section 3.3), 0 where masked."""
        x, mask = self.inputs(c)
        logit = backbone(x, Slots.of(mask))[:, 0]
        weight = torch.where(mask, torch.tanh(torch.relu(logit)), 0)
        return Prediction(logit[None], weight[None])


class PointwiseNetwork(nn.Module):
    """Perceptrons of these widths with context norm, batch norm and ReLU, and a perceptron to the outputs."""

    def __init__(self, inputs: int, widths: Sequence[int], outputs: int) -> None:
        super().__init__()
        pairs = zip((inputs, *widths), widths, strict=False)
        self.linear = nn.ModuleList(Perceptron(before, after, bias=False) for before, after in pairs)
        self.norm = nn.ModuleList(ContextBatchNormReLU(width) for width in widths)
        self.p_out = Perceptron((inputs, *widths)[-1], outputs)

    def forward(self, x: Float[Tensor, "b inputs n"], slots: Slots) -> Float[Tensor, "b outputs n"]:
        """x has to be zero in masked slots, where the result means nothing."""
        y = x.transpose(0, 1)
        for linear, norm in zip(self.linear, self.norm, strict=True):
            y = norm(linear(y), slots)
        return self.p_out(y).transpose(0, 1)  # type: ignore[no-any-return]


class DFE(_OfBackbone):
    """Iterated weighted 8-point fits; a network predicts the weights, from the second fit on with the last residuals.

    Ranftl & Koltun, "Deep fundamental matrix estimation", ECCV 2018, section 4, through `geometry.reweighted_fits`.
    What differs from the authors' code: one network serves all iterations (theirs has one for the first, one for the
    others); its layers are context norm, batch norm and ReLU over real matches, where theirs are instance norm with a
    scale and a shift, which is the same affine map, and leaky ReLU; residuals are Sampson distances on a logarithmic
    scale, since on theirs, linear to half the image, those of a pixel and of five are the same to a network; matches
    are weighted by w, theirs by w^2; and a second output gives the log-odds that a match is an inlier, since weights
    that sum to one are no probabilities.

    Args:
        widths: of the layers. As published, with five iterations, a pair costs ten times what it costs `LC`.
        iterations: fits.
        coordinates: "size" or "K", what the network sees; fits are in pixels, of fundamental matrices, in any case.
        side: side information, see `MatchInputs`.

    Raises:
        ValueError: for unknown coordinates or side information.
    """

    def __init__(
        self,
        *,
        widths: Sequence[int] = (64, 128, 1024, 512, 256),
        iterations: int = 5,
        coordinates: str = "size",
        side: Sequence[str] = (),
    ) -> None:
        super().__init__()
        if iterations < 1:
            raise ValueError(f"iterations={iterations}: at least one fit")
        self.inputs, self.iterations = MatchInputs(coordinates, tuple(side)), iterations
        self.options = {
            "widths": list(widths), "iterations": iterations, "coordinates": coordinates, "side": list(side),
        }  # fmt: skip
        self.input_channels = self.inputs.channels + 2
        self.backbone = PointwiseNetwork(self.input_channels, tuple(widths), 2)

    def predict(self, c: Correspondences, backbone: Backbone) -> Prediction:
        """One stage for each fit, with weights that sum to 1 over the matches of a pair."""
        x, mask = self.inputs(c)
        slots = Slots.of(mask)
        unit = self.inputs.unit(c)[:, None] * RESIDUAL_UNIT
        logits: list[Tensor] = []
        weights: list[Tensor] = []

        def weigh(F: Tensor | None, residual: Tensor | None) -> Tensor:
            state = torch.zeros_like(x[:, :2])
            if residual is not None:
                relative = (residual / unit).clamp_max(LARGEST_RESIDUAL / RESIDUAL_UNIT)
                share = weights[-1] * slots.matches[:, None]  # 1 on average
                state = torch.stack([torch.log1p(relative).to(x.dtype), torch.log1p(share)], 1)
                state = torch.where(mask[:, None], state, 0)
            weight_logit, logit = backbone(torch.cat([x, state], 1), slots).unbind(1)
            logits.append(logit)
            weights.append(masked_softmax(weight_logit, mask))
            return weights[-1].double()

        fits = reweighted_fits(c.x0, c.x1, weigh, self.iterations, mask)
        return Prediction(torch.stack(logits), torch.stack(weights), fits.F)


def masked_softmax(logit: Float[Tensor, "b n"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b n"]:
    """Softmax over the matches of each pair; zero where masked, also where all are."""
    lowest = torch.finfo(logit.dtype).min
    weight = torch.softmax(torch.where(mask, logit, lowest), -1)
    return torch.where(mask, weight, 0)
