"""Networks that judge matches in stages, each by what the last has found.

OANet: Zhang et al., "Learning two-view correspondences and geometry using order-aware network", ICCV 2019.
CLNet: Zhao et al., "Progressive correspondence pruning by consensus learning", ICCV 2021.
NCMNet: Liu & Yang, "Progressive neighbor consistency mining for correspondence pruning", CVPR 2023."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fmtorch.core.types import Correspondences
from fmtorch.pruning.networks import layers, learned
from fmtorch.pruning.networks.architectures import WithOptions

CONTEXT_EPS = 1e-3  # of OANet's context normalisations
MIN_RESIDUAL = 1e-6  # residual, in thresholds: bounds the log-odds of verification


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
        """DiffPool ``x S^T``, S a softmax over matches; DiffUnpool ``y S``, over clusters; both S from x."""
        share = slots.softmax(self.linear0(self.norm0(x, slots)))
        y, nodes = torch.einsum("cbn,kbn->cbk", x, share), slots.columns(len(share))
        y = layers.through(self.filters, y, nodes)
        return slots.clean(torch.einsum("cbk,kbn->cbn", y, torch.softmax(self.linear1(self.norm1(x, slots)), 0)))


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
        coordinates, side: as of `LC`.
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


class Consensus(nn.Module):
    """Log-odds of each match by its local, then by the global consensus, and the features behind them."""

    def __init__(self, embedding: nn.Module, channels: int) -> None:
        super().__init__()
        self.embedding, self.graph = embedding, layers.GlobalGraph(channels)
        self.block = layers.RectifiedBlock(channels, channels)
        self.local_logit, self.global_logit = layers.Perceptron(channels, 1), layers.Perceptron(channels, 1)

    def forward(self, x: Float[Tensor, "c b n"], slots: layers.Slots) -> tuple[Tensor, Tensor, Tensor]:
        y = self.embedding(x, slots)
        local = self.local_logit(y)[0]
        y = self.block(y + self.graph(y, local.detach(), slots), slots)
        return y, local, self.global_logit(y)[0]


class Progressive(WithOptions):
    """Prunes matches in steps, fits what is left, and judges all matches by their residuals.
    A step keeps the share `ratio` of a pair's matches, those of the largest global log-odds; the next sees both."""

    def __init__(self, embedding: Callable[..., nn.Module], **options: Any) -> None:
        """embedding: makes that of a step, of so many inputs and neighbors. options: those of `CLNet`, and more."""
        super().__init__(**options)
        channels, self.ratio, self.threshold = options["channels"], options["ratio"], options["threshold"]
        widths = ((self.inputs.channels + 2 * (i > 0), k) for i, k in enumerate(options["neighbors"]))
        self.steps = nn.ModuleList(Consensus(embedding(width, neighbors=k), channels) for width, k in widths)
        self.block, self.last = layers.RectifiedBlock(channels, channels), layers.Perceptron(channels, 2)

    def forward(self, c: Correspondences) -> learned.Prediction:
        """Stages: each step's local and global log-odds; those of the last subset, with whose weights
        ``softmax(w + log sigmoid(logit))`` is fitted; and ``log(threshold / residual)`` of all matches, without
        gradients, or the first global ones where nothing is fitted.
        Raises ValueError where image sizes or calibration matrices are missing."""
        x, mask = self.inputs(c)
        inputs = x.transpose(0, 1)
        place, left, seen = torch.arange(x.shape[2], device=x.device).expand(mask.shape), mask, inputs
        stages: list[tuple[Tensor, Tensor, Tensor]] = []  # places among all matches, which are left there, log-odds
        for step in self.steps:
            y, *logits = step(seen, layers.Slots.of(left))
            stages += [(place, left, logit) for logit in logits]
            index, left = layers.likeliest(logits[1], left, self.ratio)
            place, slots = place.gather(1, index), layers.Slots.of(left)
            weights = torch.relu(torch.tanh(torch.stack(logits).detach()))
            seen = slots.clean(torch.cat([layers.selected(inputs, place), layers.selected(weights, index)]))
            y = slots.clean(layers.selected(y, index))
        logit, weight_logit = self.last(self.block(y, slots)).to(x.dtype)
        weight = layers.spread(slots.softmax(weight_logit + nn.functional.logsigmoid(logit)), place, mask.shape)
        residual, determined = layers.fit_residuals(x, weight)
        verified = -(residual / self.threshold).clamp_min(MIN_RESIDUAL).log()
        verified = torch.where(determined[:, None], verified, stages[1][2].detach())
        stages.append((place, left, logit))
        logits = [layers.spread(torch.where(left, logit, 0), place, mask.shape) for place, left, logit in stages]
        judged = [layers.spread(left, place, mask.shape) for place, left, _ in stages]
        judged.append(torch.zeros_like(mask))
        return learned.Prediction(torch.stack([*logits, verified]), weight[None], judged=torch.stack(judged))


class LocalEmbedding(nn.Module):
    """Perceptrons, the neighbourhood by an annular convolution among the nearest features, perceptrons."""

    def __init__(self, inputs: int, channels: int, neighbors: int) -> None:
        super().__init__()
        self.neighbors, self.first = neighbors, layers.NormedPerceptron(inputs, channels)
        self.before = nn.ModuleList(layers.RectifiedBlock(channels, channels) for _ in range(4))
        self.annular = layers.AnnularConvolution(channels, neighbors // 3)
        self.after = nn.ModuleList(layers.RectifiedBlock(channels, channels) for _ in range(4))

    def forward(self, x: Float[Tensor, "c b n"], slots: layers.Slots) -> Float[Tensor, "d b n"]:
        y = layers.through(self.before, self.first(x, slots), slots)
        y = self.annular(y, slots, layers.nearest(y, slots, self.neighbors))
        return layers.through(self.after, y, slots)


class CLNet(Progressive):
    """Prunes matches by local and global consensus.

    Args:
        channels: of each layer.
        neighbors: of each step, multiples of three.
        ratio: of the matches that a step keeps.
        threshold: squared symmetric epipolar distance, in units of the coordinates, at which P(inlier) is one half.
        coordinates, side: as of `LC`.
    """

    def __init__(
        self, *, channels: int = 128, neighbors: Sequence[int] = (9, 6), ratio: float = 0.5, threshold: float = 1e-4,
        coordinates: str = "size", side: Sequence[str] = (),
    ) -> None:  # fmt: skip
        super().__init__(
            functools.partial(LocalEmbedding, channels=channels), channels=channels, neighbors=list(neighbors),
            ratio=ratio, threshold=threshold, coordinates=coordinates, side=side,
        )  # fmt: skip


# NCMNet: neighbour consistency in three spaces


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
