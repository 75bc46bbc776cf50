"""The layers that learned pruners share: perceptrons applied to each match, and normalisation over matches with a mask.

Activations are (channels, B, N): one matrix product serves all pairs, and sums over the matches of a pair run along
contiguous memory. In masked slots they are zero, and so are their gradients."""

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from fmtorch.geometry.eight_point import linear_fundamental
from fmtorch.geometry.epipolar import symmetric_squared

EPS = 1e-5  # added to variances, as torch's instance and batch norms do
MOMENTUM = 0.1  # of running statistics
FLAT = 1e-10  # variance in squared means: of equal matches that rounding tells apart, whose gradient would explode
TABLE = 2**24  # distances between matches that are held at a time
HIDDEN = 1e9  # taken off the logits of keys that are masked
MAX_RESIDUAL = 1e6  # squared units of the coordinates: of a match at an epipole, where there is no line
Running = tuple[Tensor, Tensor] | None  # mean and variance


class Slots(NamedTuple):
    """Which of the (B, N) slots hold matches.
    matches: of each pair, (B,). mask: 1 or 0, (B, N); None where every slot holds one."""

    matches: Float[Tensor, " b"]
    mask: Float[Tensor, "b n"] | None

    @classmethod
    def of(cls, mask: Bool[Tensor, "b n"], dtype: torch.dtype = torch.float32) -> "Slots":
        """Arithmetic on a mask that has no holes is left out (asking for that waits for a GPU, once a batch)."""
        return cls(mask.sum(1).to(dtype), None if bool(mask.all()) else mask.to(dtype))

    def clean(self, x: Float[Tensor, "*c b n"]) -> Float[Tensor, "*c b n"]:
        """x with zeros in the masked slots."""
        return x if self.mask is None else x * self.mask

    def softmax(self, x: Float[Tensor, "*c b n"]) -> Float[Tensor, "*c b n"]:
        """Over the matches of each pair; zero in masked slots, also where all are."""
        hidden = x if self.mask is None else torch.where(self.mask > 0, x, torch.finfo(x.dtype).min)
        return self.clean(torch.softmax(hidden, -1))

    def columns(self, count: int) -> "Slots":
        """Slots of so many columns for every pair, masked where the pair has no match."""
        mask = None if self.mask is None else (self.matches > 0).to(self.mask.dtype)[:, None].expand(-1, count)
        return Slots(self.matches * 0 + count if mask is None else mask.sum(1), mask)

    def repeated(self, times: int) -> "Slots":
        """Slots of x.repeat(1, 1, times)."""
        return Slots(self.matches * times, None if self.mask is None else self.mask.repeat(1, times))


class Perceptron(nn.Module):
    """A linear map of the channels of each match: a convolution of width 1. Initialised as torch's."""

    def __init__(self, inputs: int, outputs: int, *, bias: bool = True) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(outputs, inputs))
        self.bias = nn.Parameter(torch.empty(outputs)) if bias else None
        bound = 1 / math.sqrt(inputs)
        for parameter in (self.weight, self.bias):
            if parameter is not None:
                nn.init.uniform_(parameter, -bound, bound)

    def forward(self, x: Float[Tensor, "c b n"]) -> Float[Tensor, "d b n"]:
        """The matrix product; a bias also reaches masked slots."""
        y: Tensor = torch.mm(self.weight, x.flatten(1)).view(len(self.weight), *x.shape[1:])
        return y if self.bias is None else y + self.bias[:, None, None]


class _Norm(nn.Module):
    """Batch normalisation's scale, shift and running statistics, as torch's: momentum 0.1, variance unbiased."""

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    @torch.no_grad()
    def _remember(self, mean: Tensor, variance: Tensor, matches: Tensor) -> None:
        """A batch without matches, which has no variance, is passed over."""
        share = (matches > 0).to(variance.dtype) * MOMENTUM
        self.running_mean.lerp_(mean, share)
        self.running_var.lerp_(variance * (matches / (matches - 1).clamp_min(1)), share)


class BatchNormReLU(_Norm):
    """Batch normalisation, then ReLU, over real matches only."""

    def forward(self, x: Float[Tensor, "c b n"], slots: Slots) -> Float[Tensor, "c b n"]:
        """Zero in masked slots, whatever x is there."""
        wide = slots.clean(x if x.dtype == torch.float64 else x.float())
        mean, variance = self.running_mean, self.running_var
        if self.training:
            matches = slots.matches.sum()
            mean = wide.sum((1, 2)) / matches.clamp_min(1)
            centred = slots.clean(wide - mean[:, None, None])
            variance = centred.square().sum((1, 2)) / matches.clamp_min(1)
            self._remember(mean, variance, matches)
        scale = self.weight * (variance + EPS).rsqrt()
        return slots.clean(torch.relu(wide * scale[:, None, None] + (self.bias - mean * scale)[:, None, None]))


class ContextBatchNorm(_Norm):
    """Context normalisation, then batch normalisation, all over real matches only.
    Context normalisation (Yi et al., CVPR 2018, eq. 2 and 3) brings each channel of each pair to mean 0 and, of a
    variance v before, to variance ``v / (v + eps)``. The statistics that batch normalisation takes over all matches of
    the batch are therefore known: mean 0 and the mean of ``v / (v + eps)``, pairs weighted by their matches. Both
    normalisations are one affine map for each pair and channel, which is what is computed, with its own gradient.
    A channel constant in a pair has no gradient there. The running mean, ever nearer to 0, is for others' weights."""

    relu = False

    def __init__(self, channels: int, eps: float = EPS) -> None:
        super().__init__(channels)
        self.eps = eps  # of the context normalisation

    def forward(self, x: Float[Tensor, "c b n"], slots: Slots) -> Float[Tensor, "c b n"]:
        """Zero in masked slots, in which x has to be zero, too."""
        wide = x if x.dtype == torch.float64 else x.float()
        y, variance = _ContextBatchNorm.apply(  # type: ignore[no-untyped-call]
            wide, slots.mask, slots.matches, self.weight, self.bias,
            None if self.training else (self.running_mean, self.running_var), self.relu, self.eps,
        )  # fmt: skip
        if self.training:
            self._remember(torch.zeros_like(variance), variance, slots.matches.sum())
        return y  # type: ignore[no-any-return]


class ContextBatchNormReLU(ContextBatchNorm):
    """The same, then ReLU."""

    relu = True


class _ContextBatchNorm(torch.autograd.Function):
    """``y = g R r (x - m) + b``, or its ReLU; r = (v + eps)^-1/2 for each pair and channel, R = (V + EPS)^-1/2."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, mask: Tensor | None, count: Tensor, weight: Tensor, bias: Tensor, running: Running,
        relu: bool, eps: float,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        n = count.clamp_min(1)
        mean = x.sum(-1) / n
        centred = x - mean[..., None]
        if mask is not None:
            centred.mul_(mask)
        v = torch.linalg.vector_norm(centred, dim=-1).square() / n
        r = (v + eps).rsqrt()
        if running is None:
            V = (v * r.square() * count).sum(1) / count.sum().clamp_min(1)
            shift = bias
        else:
            V = running[1]
            shift = bias - weight * (V + EPS).rsqrt() * running[0]
        R = (V + EPS).rsqrt()
        y = torch.mul(centred, ((weight * R)[:, None] * r)[..., None]).add_(shift[:, None, None])
        if relu:
            y.relu_()
        if mask is not None:
            y.mul_(mask)
        running_mean = None if running is None else running[0]
        varies = v > FLAT * mean.square()
        ctx.save_for_backward(centred, y if relu else None, mask, count, weight, r, R, running_mean, varies)
        ctx.training, ctx.eps = running is None, eps
        ctx.mark_non_differentiable(V)
        return y, V

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, dy: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        centred, y, mask, count, weight, r, R, running_mean, varies = ctx.saved_tensors
        n = count.clamp_min(1)
        # Of y zero in masked slots, since y is.
        g = torch.ops.aten.threshold_backward(dy, y, 0) if y is not None else dy.clone() if mask is None else dy * mask
        G = g.sum(-1)
        P = (g * centred).sum(-1)
        along = (r * P).sum(1)  # of the derivative by g R, over all matches of the batch
        dbias = G.sum(1)
        dweight = R * along if running_mean is None else R * (along - running_mean * dbias)
        a = (weight * R)[:, None] * r * varies
        dv = -a * r.square() * P / 2  # through r
        if ctx.training:  # through R, by way of V = sum n v r^2 / sum n
            dV = -weight * R.pow(3) * along / 2
            dv = dv + dV[:, None] * (count / count.sum().clamp_min(1)) * ctx.eps * r.pow(4)
        dx = g.mul_(a[..., None]).addcmul_(centred, (2 * dv / n)[..., None]).sub_((a * G / n)[..., None])
        if mask is not None:
            dx.mul_(mask)
        return dx, None, None, dweight, dbias, None, None, None


class ResidualBlock(nn.Module):
    """Perceptron without bias, context norm, batch norm, ReLU; twice; the input added (Yi et al., CVPR 2018, 3.2)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear0, self.norm0 = Perceptron(channels, channels, bias=False), ContextBatchNormReLU(channels)
        self.linear1, self.norm1 = Perceptron(channels, channels, bias=False), ContextBatchNormReLU(channels)

    def forward(self, x: Float[Tensor, "c b n"], slots: Slots) -> Float[Tensor, "c b n"]:
        y = self.norm0(self.linear0(x), slots)
        return x + self.norm1(self.linear1(y), slots)  # type: ignore[no-any-return]


class NormedPerceptron(nn.Module):
    """Perceptron, batch norm, ReLU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear, self.norm = Perceptron(inputs, outputs), BatchNormReLU(outputs)

    def forward(self, x: Float[Tensor, "c b n"], slots: Slots) -> Float[Tensor, "d b n"]:
        return self.norm(self.linear(x), slots)  # type: ignore[no-any-return]


class RectifiedBlock(nn.Module):
    """Perceptron, context norm, batch norm, ReLU; without it once more; the input added; ReLU (Zhao et al., CLNet, ICCV
    2021). Where channels change a perceptron maps the input. The biases before a context norm, which takes
    them away, are kept for the authors' weights."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.linear0, self.norm0 = Perceptron(inputs, channels), ContextBatchNormReLU(channels)
        self.linear1, self.norm1 = Perceptron(channels, channels), ContextBatchNorm(channels)
        self.shortcut = Perceptron(inputs, channels) if inputs != channels else nn.Identity()

    def forward(self, x: Float[Tensor, "c b n"], slots: Slots) -> Float[Tensor, "d b n"]:
        y = self.norm0(slots.clean(self.linear0(x)), slots)
        y = self.norm1(slots.clean(self.linear1(y)), slots)
        return torch.relu(y + slots.clean(self.shortcut(x)))


def through(blocks: nn.ModuleList, x: Float[Tensor, "c b n"], slots: Slots) -> Float[Tensor, "d b n"]:
    """The blocks in sequence."""
    for block in blocks:
        x = block(x, slots)
    return x


def attention(
    query: Float[Tensor, "c b n"], key: Float[Tensor, "c b m"], value: Float[Tensor, "d b m"], slots: Slots, *,
    heads: int = 1, scale: float | None = None,
) -> Float[Tensor, "d b n"]:  # fmt: skip
    """Each query's mean of the values, by softmax of its products with the keys (Vaswani et al., NeurIPS 2017, eq. 1).
    slots: of the keys. scale: of the products; by default that of the paper."""
    q, k, v = (torch.unflatten(x, 0, (heads, -1)).permute(2, 0, 3, 1).contiguous() for x in (query, key, value))
    scale = q.shape[3] ** -0.5 if scale is None else scale
    if q.shape[3] < v.shape[3]:  # of equal widths torch needs no table of queries and keys
        q, k = (nn.functional.pad(x, (0, v.shape[3] - q.shape[3])) for x in (q, k))
    hidden = None if slots.mask is None else ((slots.mask - 1) * HIDDEN).to(q.dtype)[:, None, None]
    return nn.functional.scaled_dot_product_attention(q, k, v, hidden, scale=scale).permute(1, 3, 0, 2).flatten(0, 1)


@torch.no_grad()
def nearest(x: Float[Tensor, "c b n"], slots: Slots, count: int) -> Int[Tensor, "b n k"]:
    """The matches nearest by features, nearest first, itself among them and past the last; in full precision always."""
    wide = (x if x.dtype == torch.float64 else x.float()).transpose(0, 1)
    squared, places = wide.square().sum(1, keepdim=True), list[Tensor]()
    with torch.autocast(x.device.type, enabled=False):
        for rows in torch.split(wide, max(TABLE // (squared.numel() or 1), 1), 2):
            closeness = 2 * rows.mT @ wide - squared  # |x_i|^2 less the squared distances
            if slots.mask is not None:
                closeness = torch.where(slots.mask[:, None] > 0, closeness, -torch.inf)
            value, index = closeness.topk(min(count, x.shape[2]), -1)
            places.append(torch.where(value > -torch.inf, index, -1))
    index = torch.cat(places, 1)
    itself = torch.arange(x.shape[2], device=x.device)[:, None]
    index = torch.where(index < 0, itself, index)
    return torch.cat([index, itself.expand(*index.shape[:2], count - index.shape[2])], -1)


class AnnularConvolution(nn.Module):
    """Features of a match's neighbourhood in the local graph.
    Of the neighbours, ordered by distance, each ring of three is mapped by a perceptron of its edges ``(x, x - y)`` to
    the neighbours y, then all rings by another. What is linear in x and y is computed once for each match."""

    def __init__(self, channels: int, rings: int) -> None:
        super().__init__()
        self.edges, self.norm0 = Perceptron(6 * channels, channels), BatchNormReLU(channels)
        self.rings = NormedPerceptron(rings * channels, channels)

    def forward(
        self, x: Float[Tensor, "c b n"], slots: Slots, neighbors: Int[Tensor, "b n k"]
    ) -> Float[Tensor, "c b n"]:
        """Of k = 3 rings neighbours. Zero in masked slots."""
        c, b, n = x.shape
        own, other = self.edges.weight.view(c, 2, c, 3).unbind(1)  # of x, and of x - y in the ring's three places
        maps = torch.cat([(own + other).sum(2), *other.unbind(2)])
        own_part, *other_parts = (maps @ x.flatten(1)).view(4, c, b, n)
        rings = neighbors.shape[2] // 3
        assert self.edges.bias is not None
        y = (own_part + self.edges.bias[:, None, None]).repeat(1, 1, rings)
        for place, part in enumerate(other_parts):
            ring = neighbors[..., place::3].transpose(1, 2).reshape(b, -1)
            y = y - selected(part, ring)
        y = self.norm0(y, slots.repeated(rings)).view(c, b, rings, n)
        return self.rings(y.transpose(1, 2).reshape(c * rings, b, n), slots)  # type: ignore[no-any-return]


class GlobalGraph(nn.Module):
    """Features of all matches, aggregated over the graph of edges ``A_ij = w_i w_j``, w = relu(tanh(logit)), mapped:
    ``relu(W D^-1/2 (A + I) D^-1/2 x)``, D the sums of the rows of A + I. A has rank one, so no matrix is needed."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.perceptron = NormedPerceptron(channels, channels)

    def forward(self, x: Float[Tensor, "c b n"], logit: Float[Tensor, "b n"], slots: Slots) -> Float[Tensor, "c b n"]:
        weight = slots.clean(torch.relu(torch.tanh(logit)))
        root = (weight * weight.sum(-1, keepdim=True) + 1).rsqrt()  # D^-1/2
        scaled = x * root
        y = root * (weight * (weight * scaled).sum(-1, keepdim=True) + scaled)
        return self.perceptron(y, slots)  # type: ignore[no-any-return]


def likeliest(
    logit: Float[Tensor, "b n"], mask: Bool[Tensor, "b n"], ratio: float
) -> tuple[Int[Tensor, "b m"], Bool[Tensor, "b m"]]:
    """Places of the share of each pair's matches with the largest log-odds, rounded down, ties by place; and a mask."""
    order = torch.where(mask, logit, -torch.inf).argsort(dim=1, descending=True, stable=True)
    order = order[:, : max(int(mask.shape[1] * ratio), 1)]
    return order, torch.arange(order.shape[1], device=mask.device) < (mask.sum(1, keepdim=True) * ratio).long()


def selected(x: Float[Tensor, "c b n"], index: Int[Tensor, "b m"]) -> Float[Tensor, "c b m"]:
    """The columns of these places."""
    return x.gather(2, index.expand(len(x), -1, -1))


def spread(x: Shaped[Tensor, "b m"], place: Int[Tensor, "b m"], shape: torch.Size) -> Shaped[Tensor, "b n"]:
    """Values at their places, and zero or False elsewhere."""
    return torch.zeros(shape, dtype=x.dtype, device=x.device).scatter(1, place, x)


@torch.no_grad()
def fit_residuals(
    x: Float[Tensor, "b c n"], weight: Float[Tensor, "b n"]
) -> tuple[Float[Tensor, "b n"], Bool[Tensor, " b"]]:
    """Squared symmetric epipolar distances under the weighted 8-point fit, and whether there is one; 0 where not.
    x: the inputs of matches, whose first four channels are coordinates; the distances have their unit. The fit is that
    of `linear_fundamental`, of any rank, without gradients, as published (Zhang et al., OANet, ICCV 2019)."""
    x0, x1 = (points.mT.double() for points in (x[:, :2], x[:, 2:4]))
    F, determined = linear_fundamental(x0, x1, weight.double())
    squared = symmetric_squared(torch.where(determined[:, None, None], F, 0), x0, x1)
    return squared.clamp(max=MAX_RESIDUAL).to(x.dtype), determined
