"""ConvMatch: Zhang & Ma, "ConvMatch: Rethinking network design for two-view correspondence learning", AAAI 2023."""

import itertools
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.core.types import Correspondences
from fmtorch.pruning.networks import layers, learned
from fmtorch.pruning.networks.architectures import OfBackbone

EXTENT = {"size": 0.5, "K": 1.0}  # half a side of the grid: the longer side of image 0; one focal length, as published
WIDTHS = 64, 16, 4  # of the layers that predict log-odds
CONTEXT_EPS = 1e-3


class Projection(nn.Module):
    """Two numbers, or those of motion and side information, to features."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.hidden0, self.hidden1 = layers.NormedPerceptron(inputs, 32), layers.NormedPerceptron(32, 64)
        self.last = layers.Perceptron(64, channels)

    def forward(self, x: Float[Tensor, "c b n"], slots: layers.Slots) -> Float[Tensor, "d b n"]:
        return slots.clean(self.last(self.hidden1(self.hidden0(x, slots), slots)))


class Attention(nn.Module):
    """``x + MLP([x, attention of x to y])``: motions to the grid, and back."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value, self.merge = (layers.Perceptron(channels, channels) for _ in range(4))
        self.hidden = layers.NormedPerceptron(2 * channels, 2 * channels)
        self.last = layers.Perceptron(2 * channels, channels)

    def forward(
        self, x: Float[Tensor, "c b n"], y: Float[Tensor, "c b m"], slots_x: layers.Slots, slots_y: layers.Slots
    ) -> Float[Tensor, "c b n"]:
        attended = layers.attention(self.query(x), self.key(y), self.value(y), slots_y, heads=self.heads)
        return x + slots_x.clean(self.last(self.hidden(torch.cat([x, self.merge(attended)]), slots_x)))


class GridFilter(nn.Module):
    """Three residual blocks of two 3 x 3 convolutions over the grid of motions, and a perceptron."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(nn.Conv2d(channels, channels, 3, padding=1) for _ in range(6))
        self.norms = nn.ModuleList(layers.BatchNormReLU(channels) for _ in range(6))
        self.last = layers.Perceptron(channels, channels)

    def forward(self, x: Float[Tensor, "c b m"], slots: layers.Slots, side: int) -> Float[Tensor, "c b m"]:
        before = x
        for i, (convolution, norm) in enumerate(zip(self.convolutions, self.norms, strict=True)):
            grid = convolution(torch.unflatten(x.transpose(0, 1), 2, (side, side)))
            x = norm(grid.flatten(2).transpose(0, 1), slots)
            if i % 2:
                x = before = x + before
        return slots.clean(self.last(x))


class Layer(nn.Module):
    """Motions aligned to the grid, filtered there, and taken back; log-odds from what changed."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.align, self.back = Attention(channels, heads), Attention(channels, heads)
        self.filter = GridFilter(channels)
        pairs = list(itertools.pairwise((channels, *WIDTHS)))
        self.hidden = nn.ModuleList(layers.Perceptron(*pair) for pair in pairs)
        self.norms = nn.ModuleList(layers.ContextBatchNormReLU(width, CONTEXT_EPS) for width in WIDTHS)
        self.last = layers.Perceptron(WIDTHS[-1], 1)

    def forward(self, x: Tensor, grid: Tensor, slots: layers.Slots, side: int) -> tuple[Tensor, Tensor]:
        """The motions' features (c, b, n) and log-odds (1, b, n)."""
        nodes = slots.columns(side * side)
        motion = self.filter(self.align(grid, x, nodes, slots), nodes, side)
        after = self.back(x, motion, slots, nodes)
        y = after - x
        for linear, norm in zip(self.hidden, self.norms, strict=True):
            y = norm(slots.clean(linear(y)), slots)
        return after, self.last(y)


class MotionField(nn.Module):
    """All layers; from the inputs of matches to log-odds of each layer."""

    centres: Tensor

    def __init__(self, inputs: int, channels: int, layer_count: int, heads: int, side: int, extent: float) -> None:
        super().__init__()
        self.side = side
        self.position, self.grid_position = Projection(2, channels), Projection(2, channels)
        self.motion = Projection(inputs - 2, channels)
        self.layers = nn.ModuleList(Layer(channels, heads) for _ in range(layer_count))
        x = torch.linspace(1 / side - 1, 1 - 1 / side, side) * extent
        self.register_buffer("centres", torch.cartesian_prod(-x, x).T.flip(0), persistent=False)  # (x, y), y falling

    def forward(self, x: Float[Tensor, "b inputs n"], slots: layers.Slots) -> Float[Tensor, "b layers n"]:
        """x has to be zero in masked slots, where the result means nothing."""
        x0, x1, side = x.transpose(0, 1).tensor_split((2, 4))
        y = self.motion(torch.cat([x1 - x0, side]), slots) + self.position(x0, slots)
        alike = layers.Slots(torch.full_like(slots.matches[:1], self.side**2), None)  # the grid, the same for all pairs
        grid = self.grid_position(self.centres[:, None].to(x.dtype), alike).expand(-1, x.shape[0], -1)
        grid = slots.columns(self.side**2).clean(grid)
        logits = []
        for layer in self.layers:
            y, logit = layer(y, grid, slots, self.side)
            logits.append(logit)
        return torch.cat(logits).transpose(0, 1)


class ConvMatch(OfBackbone):
    """Classifies matches by a regular grid of motions, which convolutions smooth.

    Args:
        channels: of each layer. layers: each with log-odds of its own. heads: of attention.
        grid: cells along a side, over [-1/2, 1/2]^2 with coordinates="size", over [-1, 1]^2 with "K", as published.
        coordinates: "size", for the fundamental matrix, or "K", for the essential matrix.
        side: side information, see `MatchInputs`; beside the motion.

    Raises:
        ValueError: for unknown coordinates or side information.
    """

    def __init__(
        self, *, channels: int = 128, layers: int = 6, heads: int = 4, grid: int = 16, coordinates: str = "size",
        side: Sequence[str] = (),
    ) -> None:  # fmt: skip
        super().__init__(coordinates, side, channels=channels, layers=layers, heads=heads, grid=grid)
        self.input_channels = self.inputs.channels
        self.backbone = MotionField(self.input_channels, channels, layers, heads, grid, EXTENT[coordinates])

    def predict(self, c: Correspondences, backbone: learned.Backbone) -> learned.Prediction:
        """A prediction of each layer, ``weight = relu(tanh(logit))``."""
        x, mask = self.inputs(c)
        logit = backbone(x, layers.Slots.of(mask)).transpose(0, 1)
        return learned.Prediction(logit, torch.where(mask, torch.relu(torch.tanh(logit)), 0))
