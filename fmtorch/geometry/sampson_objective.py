"""The robust Sampson error of many models on the points they share, with its normal equations, component by component.

Everything is element-wise, a product of matrices of one fixed shape, or summed in a fixed order, so a model has the
same bits in any batch.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.arithmetic import component_sum, stable_sum
from fmtorch.geometry.residuals import homogeneous, linearise
from fmtorch.geometry.robust_losses import Kernel

LANES = 64  # points are summed in blocks of so many, and these one by one: part of the result's last bits
TILE_MODELS = 24  # models whose sums stay in the L2 cache together; changes no result
TILE_ELEMENTS = 1 << 13  # points times models of one step; changes no result


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


class SampsonObjective:
    """The robust cost of models of some pairs, with its normal equations, in tiles that stay in the cache.

    scale: of the kernel, one for all matches of a pair, (p,) or (p, 1), or one for each (p, n).
    """

    def __init__(
        self,
        points: Float[Tensor, "4 p n"],
        weight: Float[Tensor, "p n"],
        robust: Kernel,
        scale: Float[Tensor, " p"] | Float[Tensor, "p slots"],
    ) -> None:
        s2 = scale.square() if scale.dim() > 1 else scale.square()[:, None]
        if s2.shape[1] > 1:
            s2 = torch.nn.functional.pad(s2, (0, -s2.shape[1] % LANES), value=1)
            self.s2 = s2.reshape(len(s2), -1, 1, LANES).transpose(0, 1).contiguous()
        else:
            self.s2 = s2[None, :, :, None]
        points, self.weight = blocks(points, weight)
        self.points, self.robust = homogeneous(points), robust

    def __call__(
        self, F: Float[Tensor, "9 p k"], derivatives: bool
    ) -> tuple[Float[Tensor, "rows columns p k"], Float[Tensor, "p k"]]:
        """The weighted products of Jacobian and residual, [[J^T W J, J^T W r], [.., r^T W r]] (10, 10), and the cost.

        W holds the weights times those of the kernel. Without derivatives the first is empty.
        Blocks are added one after the other, so zeros at the end change nothing.
        """
        p, k = F.shape[1:]
        pairs = max(1, TILE_MODELS // max(1, k))
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
        points, weight, s2 = self.points[:, :, :, pairs], self.weight[:, pairs], self.s2[:, pairs]
        count = max(1, TILE_ELEMENTS // (max(1, F[0].numel()) * LANES))
        products, costs = [], []
        for first in range(0, len(weight), count):
            some = slice(first, first + count)
            w, scale = weight[some], s2[some] if len(s2) > 1 else s2
            J, e, inverse, r2 = linearise(F, points[:, :, some], derivatives)
            loss = self.robust.loss(r2, scale)
            costs.append(block_products(loss[None], w.expand_as(loss)[None]))
            if derivatives:
                A = torch.cat([J.flatten(0, 1), e[None]])
                products.append(block_products(A, A * (self.robust.weight(r2, scale) * w * inverse)))
        cost = _in_order(costs)[0, 0]
        return _in_order(products) if derivatives else F.new_empty(0, 0, *cost.shape), cost


def block_products(
    a: Float[Tensor, "r m p k lanes"], b: Float[Tensor, "c m p k lanes"], elementwise: bool | None = None
) -> Float[Tensor, "m r c p k"]:
    """For each block, the sums over its lanes of all products of a row of a and a row of b.

    On a CPU by BLAS, which multiplies matrices of one fixed shape, each beginning on a cache line, in the same way
    wherever they stand, and seven to eleven times as fast as element by element. A GPU's library chooses a kernel by
    the number of matrices, so there (or if asked) element by element, in a fixed order.
    """
    if a.is_cuda if elementwise is None else elementwise:
        return torch.stack([stable_sum(x[:, None] * y) for x, y in zip(a.unbind(1), b.unbind(1), strict=True)])
    rows, columns = (x.flatten(1, 3).transpose(0, 1) for x in (a, b))
    return torch.bmm(rows, columns.mT).view(*a.shape[1:4], len(a), len(b)).permute(0, 3, 4, 1, 2)


def _in_order(blocks: list[Tensor]) -> Tensor:
    """The sum over all blocks, one after the other: those of zeros at the end change nothing."""
    return component_sum(blocks[0] if len(blocks) == 1 else torch.cat(blocks))
