"""NCMNet: Liu & Yang, "Progressive neighbor consistency mining for correspondence pruning", CVPR 2023."""

import functools
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.pruning.networks import layers
from fmtorch.pruning.networks.clnet import Progressive
from fmtorch.pruning.networks.oanet import OrderAwareContext


class CrossInteraction(nn.Module):
    """Features of one neighbourhood, mixed among matches by attention between two others:
    ``z + gamma g(v(z) softmax(q(x)^T k(y))^T)``."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.query, self.key, self.value, self.result = (
            layers.NormedPerceptron(channels, outputs) for outputs in (channels // 4, channels // 4, channels, channels)
        )
        self.gamma = nn.Parameter(torch.zeros(1))

    def forward(
        self, x: Float[Tensor, "c b n"], y: Float[Tensor, "c b n"], z: Float[Tensor, "c b n"], slots: layers.Slots
    ) -> Float[Tensor, "c b n"]:
        query, key, value = self.query(x, slots), self.key(y, slots), self.value(z, slots)
        return z + self.gamma * self.result(layers.attention(query, key, value, slots, scale=1.0), slots)  # type: ignore[no-any-return]


class NeighborConsistency(nn.Module):
    """The consistency of a match with its neighbours in three spaces: of coordinates, of features, and of features
    aggregated over the global graph; with the context by clusters, to new features.
    Of the global graph only neighbours' indices are used, so its parameters are never trained, as in their code."""

    def __init__(self, channels: int, neighbors: int, clusters: int) -> None:
        super().__init__()
        self.neighbors = neighbors
        self.logit = layers.Perceptron(channels, 1).requires_grad_(False)
        self.graph = layers.GlobalGraph(channels).requires_grad_(False)
        self.annular = nn.ModuleList(layers.AnnularConvolution(channels, neighbors // 3) for _ in range(3))
        self.interaction = nn.ModuleList(CrossInteraction(channels) for _ in range(3))
        self.context = OrderAwareContext(channels, clusters, 2)
        self.blocks = nn.ModuleList(layers.RectifiedBlock(channels * (4 if i == 0 else 1), channels) for i in range(3))

    def forward(self, x: Float[Tensor, "c b n"], slots: layers.Slots, spatial: Tensor) -> Float[Tensor, "c b n"]:
        """spatial: neighbours by coordinates."""
        with torch.no_grad():
            graph = self.graph(x, self.logit(x)[0], slots)
        spaces = spatial, layers.nearest(x, slots, self.neighbors), layers.nearest(graph, slots, self.neighbors)
        s, f, g = (each(x, slots, index) for each, index in zip(self.annular, spaces, strict=True))
        mixed = [
            each(*abc, slots) for each, abc in zip(self.interaction, ((f, g, s), (g, s, f), (s, f, g)), strict=True)
        ]
        return layers.through(self.blocks, torch.cat([*mixed, self.context(x, slots)]), slots)


class Embedding(nn.Module):
    """Perceptrons and two rounds of neighbour consistency."""

    def __init__(self, inputs: int, channels: int, neighbors: int, clusters: int) -> None:
        super().__init__()
        self.neighbors, self.first = neighbors, layers.NormedPerceptron(inputs, channels)
        self.blocks = nn.ModuleList(layers.RectifiedBlock(channels, channels) for _ in range(3))
        self.rounds = nn.ModuleList(NeighborConsistency(channels, neighbors, clusters) for _ in range(2))

    def forward(self, x: Float[Tensor, "c b n"], slots: layers.Slots) -> Float[Tensor, "d b n"]:
        spatial, y = layers.nearest(x, slots, self.neighbors), layers.through(self.blocks, self.first(x, slots), slots)
        for each in self.rounds:
            y = each(y, slots, spatial)
        return y


class NCMNet(Progressive):
    """Prunes matches as `CLNet`, by their consistency with neighbours in three spaces.

    Args:
        channels, neighbors, ratio, threshold, coordinates, side: as of `CLNet`.
        clusters: of the matches, as of `OANet`.

    Raises:
        ValueError: for unknown coordinates or side information.
    """

    def __init__(
        self, *, channels: int = 128, neighbors: Sequence[int] = (9, 6), clusters: int = 250, ratio: float = 0.5,
        threshold: float = 1e-4, coordinates: str = "size", side: Sequence[str] = (),
    ) -> None:  # fmt: skip
        super().__init__(
            functools.partial(Embedding, channels=channels, clusters=clusters), channels=channels,
            neighbors=list(neighbors), clusters=clusters, ratio=ratio, threshold=threshold, coordinates=coordinates,
            side=side,
        )  # fmt: skip
