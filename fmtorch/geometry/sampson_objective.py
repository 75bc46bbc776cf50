"""The robust Sampson error of many models on the points they share, with its normal equations, component by component.

Everything is element-wise or summed in a fixed order, so a model has the same bits in any batch.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.reduce import component_sum, stable_sum
from fmtorch.geometry.robust_kernels import Kernel

LANES = 64  # points are summed one by one into so many lanes, and these in a tree: part of the result's last bits
TILE_MODELS = 8  # models whose sums stay in the L2 cache together; changes no result
TILE_ELEMENTS = 1 << 13  # points times models of one step; changes no result
TINY = 1e-30  # squared slope of the epipolar constraint below which it is taken for this


def blocks(
    points: Float[Tensor, "4 p n"], weight: Float[Tensor, "p n"]
) -> tuple[Float[Tensor, "4 m p 1 lanes"], Float[Tensor, "m p 1 lanes"]]:
    """Points and weights cut into blocks of LANES, the last one padded with zeros of weight zero."""
    p, n = weight.shape
    m = max(1, -(-n // LANES))
    if n < m * LANES:
        points = torch.nn.functional.pad(points, (0, m * LANES - n))
        weight = torch.nn.functional.pad(weight, (0, m * LANES - n))
    points = points.reshape(4, p, m, 1, LANES).transpose(1, 2).contiguous()
    return points, weight.reshape(p, m, 1, LANES).transpose(0, 1).contiguous()


class Objective:
    """The robust cost of models of some pairs, with its normal equations, in tiles that stay in the cache."""

    def __init__(
        self,
        points: Float[Tensor, "4 p n"],
        weight: Float[Tensor, "p n"],
        robust: Kernel,
        scale: Float[Tensor, " p"],
    ) -> None:
        self.points, self.weight = blocks(points, weight)
        self.robust, self.s2 = robust, scale.square()[:, None, None]
        self.buffers: dict[tuple[int, ...], Tensor] = {}

    def __call__(
        self, F: Float[Tensor, "9 p k"], derivatives: bool
    ) -> tuple[Float[Tensor, "rows columns p k"], Float[Tensor, "p k"]]:
        """The weighted products of Jacobian and residual, [[J^T W J, J^T W r], [.., r^T W r]] (10, 10), and the cost.

        W holds the weights times those of the kernel. Without derivatives the first is empty.
        Each lane adds its points one after the other, so zeros at the end change nothing.
        """
        p, k = F.shape[1:]
        pairs = max(1, TILE_MODELS // k)
        if p <= pairs and k <= TILE_MODELS:
            return self._tile(F, slice(None), derivatives)
        rows = 10 if derivatives else 0
        products, cost = F.new_empty(rows, rows, p, k), F.new_empty(p, k)
        for i in range(0, p, pairs):
            some = slice(i, i + pairs)
            for j in range(0, k, TILE_MODELS):
                models = slice(j, j + TILE_MODELS)
                products[..., some, models], cost[some, models] = self._tile(F[:, some, models], some, derivatives)
        return products, cost

    def _tile(self, F: Tensor, pairs: slice, derivatives: bool) -> tuple[Tensor, Tensor]:
        points, weight, s2 = self.points[:, :, pairs], self.weight[:, pairs], self.s2[pairs]
        p, k = F.shape[1:]
        f = F[..., None].unbind(0)
        m, count = len(weight), max(1, TILE_ELEMENTS // (p * k * LANES))
        losses: list[Tensor] = []
        sums = self._buffer(101, p, k, LANES)  # of the products, then the cost
        products = sums[:100].view(10, 10, p, k, LANES)
        for first in range(0, m, count):
            some = slice(first, first + count)
            w = weight[some]
            rows, inverse, r2 = linearise(f, points[:, some], derivatives)
            losses.append(self.robust.loss(r2, s2) * w)
            if not derivatives:
                continue
            A, B = self._buffer(2, len(w), 10, p, k, LANES).unbind(0)
            torch.stack(rows, 1, out=A)
            torch.mul(A, (self.robust.weight(r2, s2) * w * inverse)[:, None], out=B)
            for j, (a, b) in enumerate(zip(A[:, :, None].unbind(0), B[:, None].unbind(0), strict=True), start=first):
                if j == 0:
                    torch.mul(a, b, out=products)
                else:
                    products.addcmul_(a, b)
        cost = component_sum(losses[0] if len(losses) == 1 else torch.cat(losses))
        if not derivatives:
            return F.new_empty(0, 0, p, k), stable_sum(cost)
        sums[100] = cost
        half = LANES // 2  # the first level of the tree in place: memory newly mapped costs more than the sum
        sums = stable_sum(sums[..., :half].add_(sums[..., half:]))
        return sums[:100].view(10, 10, p, k), sums[100]

    def _buffer(self, *shape: int) -> Tensor:
        if shape not in self.buffers:
            self.buffers[shape] = self.points.new_empty(shape)
        return self.buffers[shape]


def linearise(
    f: Sequence[Float[Tensor, "p k 1"]], points: Float[Tensor, "4 m p 1 lanes"], derivatives: bool = True
) -> tuple[list[Tensor], Float[Tensor, "m p k lanes"], Float[Tensor, "m p k lanes"]]:
    """The Sampson residual ``r = e / g`` and its Jacobian: g J (nine of them, then e), 1 / g^2, and r^2.

    ``e = x1^T F x0``, ``g^2`` the squared norm of the first two entries of ``F x0`` and ``F^T x1`` together (Hartley &
    Zisserman 2004, equation 11.9), so ``g dr = x1^T dF x0 - (e / g^2) ((F x0)^T D dF x0 + x1^T dF D F^T x1)`` with
    ``D = diag(1, 1, 0)``: the sum of two products of a column and a row.
    """
    x0, y0, x1, y1 = points
    a1 = torch.addcmul(torch.addcmul(f[2], f[0], x0), f[1], y0)
    b1 = torch.addcmul(torch.addcmul(f[5], f[3], x0), f[4], y0)
    c1 = torch.addcmul(torch.addcmul(f[8], f[6], x0), f[7], y0)
    a0 = torch.addcmul(torch.addcmul(f[6], f[0], x1), f[3], y1)
    b0 = torch.addcmul(torch.addcmul(f[7], f[1], x1), f[4], y1)
    e = torch.addcmul(torch.addcmul(c1, a1, x1), b1, y1)
    slope = torch.addcmul(torch.addcmul(torch.addcmul(a1 * a1, b1, b1), a0, a0), b0, b0)
    inverse = slope.clamp_min(TINY).reciprocal()
    c = e * inverse
    r2 = e * c
    if not derivatives:
        return [], inverse, r2
    u, v = torch.addcmul(x1, c, a1, value=-1), torch.addcmul(y1, c, b1, value=-1)  # x1 - c D F x0
    s, t = -c * a0, -c * b0  # -c D F^T x1
    rows = [
        torch.addcmul(u * x0, s, x1), torch.addcmul(u * y0, t, x1), u,
        torch.addcmul(v * x0, s, y1), torch.addcmul(v * y0, t, y1), v,
        s + x0, t + y0, torch.ones_like(e), e,
    ]  # fmt: skip
    return rows, inverse, r2
