"""The layers that learned pruners share: perceptrons applied to each match, and normalisation over matches with a mask.

Activations are (channels, B, N): one matrix product serves all pairs, and sums over the matches of a pair run along
contiguous memory. In masked slots they are zero, and so are their gradients.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

EPS = 1e-5  # added to variances, as torch's instance and batch norms do
MOMENTUM = 0.1  # of running statistics
Running = tuple[Tensor, Tensor] | None  # mean and variance


class Slots(NamedTuple):
    """Which of the (B, N) slots hold matches.
    matches: of each pair, (B,). mask: 1 or 0, (B, N); None where every slot holds one."""

    matches: Float[Tensor, " b"]
    mask: Float[Tensor, "b n"] | None

    @classmethod
    def of(cls, mask: Bool[Tensor, "b n"], dtype: torch.dtype = torch.float32) -> Slots:
        """Arithmetic on a mask that has no holes is left out (asking for that waits for a GPU, once a batch)."""
        return cls(mask.sum(1).to(dtype), None if bool(mask.all()) else mask.to(dtype))

    def clean(self, x: Float[Tensor, "c b n"]) -> Float[Tensor, "c b n"]:
        """x with zeros in the masked slots."""
        return x if self.mask is None else x * self.mask


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


class ContextBatchNormReLU(nn.Module):
    """Context normalisation, then batch normalisation, then ReLU, all over real matches only.
    Context normalisation (Yi et al., CVPR 2018, eq. 2 and 3) brings each channel of each pair to mean 0 and, of a
    variance v before, to variance ``v / (v + eps)``. The statistics that batch normalisation takes over all matches of
    the batch are therefore known: mean 0 and the mean of ``v / (v + eps)``, pairs weighted by their matches. Both
    normalisations are one affine map for each pair and channel, which is what is computed, with its own gradient.
    Running statistics as torch's BatchNorm keeps them: momentum 0.1, variance times ``M / (M - 1)`` for M matches. The
    running mean only ever moves towards 0; it is kept for weights trained elsewhere."""

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def forward(self, x: Float[Tensor, "c b n"], slots: Slots) -> Float[Tensor, "c b n"]:
        """Zero in masked slots, in which x has to be zero, too."""
        wide = x if x.dtype == torch.float64 else x.float()
        y, variance = _NormReLU.apply(  # type: ignore[no-untyped-call]
            wide, slots.mask, slots.matches, self.weight, self.bias,
            None if self.training else (self.running_mean, self.running_var),
        )  # fmt: skip
        if self.training:
            self._remember(variance, slots.matches.sum())
        return y  # type: ignore[no-any-return]

    @torch.no_grad()
    def _remember(self, variance: Tensor, matches: Tensor) -> None:
        """A batch without matches, which has no variance, is passed over."""
        share = (matches > 0).to(variance.dtype) * MOMENTUM
        self.running_mean.lerp_(torch.zeros_like(self.running_mean), share)
        self.running_var.lerp_(variance * (matches / (matches - 1).clamp_min(1)), share)

    def folded(self) -> tuple[Float[Tensor, " c"], Float[Tensor, " c"]]:
        """At inference: scale and shift of the context-normalised activations that batch norm amounts to."""
        scale = self.weight * (self.running_var + EPS).rsqrt()
        return scale, self.bias - scale * self.running_mean


class _NormReLU(torch.autograd.Function):
    """``y = relu(g R r (x - m) + b)``, r = (v + eps)^-1/2 for each pair and channel, R = (V + eps)^-1/2."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, mask: Tensor | None, count: Tensor, weight: Tensor, bias: Tensor, running: Running
    ) -> tuple[Tensor, Tensor]:
        n = count.clamp_min(1)
        centred = x - (x.sum(-1) / n)[..., None]
        if mask is not None:
            centred.mul_(mask)
        v = torch.linalg.vector_norm(centred, dim=-1).square() / n
        r = (v + EPS).rsqrt()
        if running is None:
            V = (v * r.square() * count).sum(1) / count.sum().clamp_min(1)
            shift = bias
        else:
            V = running[1]
            shift = bias - weight * (V + EPS).rsqrt() * running[0]
        R = (V + EPS).rsqrt()
        y = torch.mul(centred, ((weight * R)[:, None] * r)[..., None]).add_(shift[:, None, None]).relu_()
        if mask is not None:
            y.mul_(mask)
        ctx.save_for_backward(centred, y, mask, count, weight, r, R, None if running is None else running[0])
        ctx.training = running is None
        ctx.mark_non_differentiable(V)
        return y, V

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, dy: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        centred, y, mask, count, weight, r, R, running_mean = ctx.saved_tensors
        n = count.clamp_min(1)
        g = torch.ops.aten.threshold_backward(dy, y, 0)  # zero in masked slots, since y is
        G = g.sum(-1)
        P = (g * centred).sum(-1)
        along = (r * P).sum(1)  # of the derivative by g R, over all matches of the batch
        dbias = G.sum(1)
        dweight = R * along if running_mean is None else R * (along - running_mean * dbias)
        a = (weight * R)[:, None] * r
        dv = -a * r.square() * P / 2  # through r
        if ctx.training:  # through R, by way of V = sum n v r^2 / sum n
            dV = -weight * R.pow(3) * along / 2
            dv = dv + dV[:, None] * (count / count.sum().clamp_min(1)) * EPS * r.pow(4)
        dx = g.mul_(a[..., None]).addcmul_(centred, (2 * dv / n)[..., None]).sub_((a * G / n)[..., None])
        if mask is not None:
            dx.mul_(mask)
        return dx, None, None, dweight, dbias, None


class ResidualBlock(nn.Module):
    """Perceptron, context norm, batch norm, ReLU; twice; and the input added (Yi et al., CVPR 2018, section 3.2).
    Its perceptrons have no bias: context normalisation takes any away."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear0, self.norm0 = Perceptron(channels, channels, bias=False), ContextBatchNormReLU(channels)
        self.linear1, self.norm1 = Perceptron(channels, channels, bias=False), ContextBatchNormReLU(channels)

    def forward(self, x: Float[Tensor, "c b n"], slots: Slots) -> Float[Tensor, "c b n"]:
        y = self.norm0(self.linear0(x), slots)
        y = self.norm1(self.linear1(y), slots)
        return x + y  # type: ignore[no-any-return]
