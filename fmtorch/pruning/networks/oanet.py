"""OANet: Zhang et al., "Learning two-view correspondences and geometry using order-aware network", ICCV 2019."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.core.types import Correspondences
from fmtorch.pruning.networks import layers, learned
from fmtorch.pruning.networks.architectures import WithOptions

CONTEXT_EPS = 1e-3  # of its context normalisations


class PreNormBlock(nn.Module):
    """Context norm, batch norm, ReLU, perceptron; twice; the input added, by a perceptron where channels change.
    The bias before the second context norm, which takes it away, is kept for the authors' weights."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.norm0 = layers.ContextBatchNormReLU(inputs, CONTEXT_EPS)
        self.linear0 = layers.Perceptron(inputs, channels)
        self.norm1 = layers.ContextBatchNormReLU(channels, CONTEXT_EPS)
        self.linear1 = layers.Perceptron(channels, channels)
        self.shortcut = layers.Perceptron(inputs, channels) if inputs != channels else nn.Identity()

    def forward(self, x: Float[Tensor, "c b n"], slots: layers.Slots) -> Float[Tensor, "d b n"]:
        y = slots.clean(self.linear0(self.norm0(x, slots)))
        return slots.clean(self.linear1(self.norm1(y, slots)) + self.shortcut(x))


class OrderAwareFilter(nn.Module):
    """A block of perceptrons over channels, with one over the clusters, whose order is fixed, between."""

    def __init__(self, channels: int, clusters: int) -> None:
        super().__init__()
        self.norm0 = layers.ContextBatchNormReLU(channels, CONTEXT_EPS)
        self.linear0 = layers.Perceptron(channels, channels)
        self.norm1, self.linear1 = layers.BatchNormReLU(clusters), layers.Perceptron(clusters, clusters)
        self.norm2 = layers.ContextBatchNormReLU(channels, CONTEXT_EPS)
        self.linear2 = layers.Perceptron(channels, channels)

    def forward(self, x: Float[Tensor, "c b k"], slots: layers.Slots) -> Float[Tensor, "c b k"]:
        y = self.linear0(self.norm0(x, slots))
        across = self.linear1(self.norm1(y.permute(2, 1, 0), slots.columns(len(x))))
        y = slots.clean(y + across.permute(2, 1, 0))
        return x + slots.clean(self.linear2(self.norm2(y, slots)))


class OrderAwareContext(nn.Module):
    """The matches' context by way of clusters: pooled, filtered, unpooled."""

    def __init__(self, channels: int, clusters: int, filters: int) -> None:
        super().__init__()
        self.norm0 = layers.ContextBatchNormReLU(channels, CONTEXT_EPS)
        self.linear0 = layers.Perceptron(channels, clusters)
        self.filters = nn.ModuleList(OrderAwareFilter(channels, clusters) for _ in range(filters))
        self.norm1 = layers.ContextBatchNormReLU(channels, CONTEXT_EPS)
        self.linear1 = layers.Perceptron(channels, clusters)

    def forward(self, x: Float[Tensor, "c b n"], slots: layers.Slots) -> Float[Tensor, "c b n"]:
        """DiffPool: ``S = softmax over matches, x S^T``; DiffUnpool: ``S = softmax over clusters, y S``;
        both S from x."""
        share = slots.softmax(self.linear0(self.norm0(x, slots)))
        y, nodes = torch.einsum("cbn,kbn->cbk", x, share), slots.columns(len(share))
        y = layers.through(self.filters, y, nodes)
        share = torch.softmax(self.linear1(self.norm1(x, slots)), 0)
        return slots.clean(torch.einsum("cbk,kbn->cbn", y, share))


class Stage(nn.Module):
    """Blocks, context by clusters and blocks on both, to a log-odds of each match."""

    def __init__(self, inputs: int, channels: int, blocks: int, clusters: int) -> None:
        super().__init__()
        self.first = layers.Perceptron(inputs, channels)
        self.before = nn.ModuleList(PreNormBlock(channels, channels) for _ in range(blocks))
        self.context = OrderAwareContext(channels, clusters, blocks)
        self.after = nn.ModuleList(PreNormBlock(channels * (1 + (i == 0)), channels) for i in range(blocks))
        self.last = layers.Perceptron(channels, 1)

    def forward(self, x: Float[Tensor, "c b n"], slots: layers.Slots) -> Float[Tensor, "b n"]:
        y = layers.through(self.before, slots.clean(self.first(x)), slots)
        y = layers.through(self.after, torch.cat([y, self.context(y, slots)]), slots)
        return self.last(y)[0]  # type: ignore[no-any-return]


class OANet(WithOptions):
    """Classifies matches in stages; each further one sees the weights of the last and the residuals of their fit.

    Args:
        channels: of each layer.
        blocks: of all stages; half of a stage's filter clusters, as many blocks stand before and after.
        clusters: of the matches.
        stages: the first, and those that refine it, with parameters of their own.
        coordinates: "size", for the fundamental matrix, or "K", for the essential matrix as published.
        side: side information, see `MatchInputs`.

    Raises:
        ValueError: for unknown coordinates or side information.
    """

    def __init__(
        self, *, channels: int = 128, blocks: int = 12, clusters: int = 500, stages: int = 2, coordinates: str = "size",
        side: Sequence[str] = (),
    ) -> None:  # fmt: skip
        super().__init__(coordinates, side, channels=channels, blocks=blocks, clusters=clusters, stages=stages)
        inputs, half = self.inputs.channels, blocks // stages // 2
        self.stages = nn.ModuleList(Stage(inputs + 2 * (i > 0), channels, half, clusters) for i in range(stages))

    def forward(self, c: Correspondences) -> learned.Prediction:
        """A prediction of each stage, ``weight = relu(tanh(logit))``.
        Raises ValueError where image sizes or calibration matrices are missing."""
        x, mask = self.inputs(c)
        slots, logits, weights = layers.Slots.of(mask), list[Tensor](), list[Tensor]()
        for stage in self.stages:
            seen = x
            if weights:
                residual, _ = layers.fit_residuals(x, weights[-1])
                seen = torch.cat([x, torch.stack([residual, weights[-1].detach()], 1)], 1)
            logits.append(stage(seen.transpose(0, 1), slots))
            weights.append(torch.where(mask, torch.relu(torch.tanh(logits[-1])), 0))
        return learned.Prediction(torch.stack(logits), torch.stack(weights))
