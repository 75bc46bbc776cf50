"""The way into the solvers: leading shapes flattened, masked slots moved to the end, coordinates normalised."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.compiling.arrays import Array
from fmtorch.geometry.arithmetic import as_components, as_matrices, unit
from fmtorch.geometry.pixel_frame import PixelFrame
from fmtorch.geometry.sampson_objective_kernels import LOSSES, Weighted, loss_table


class NormalizedMatches:
    """Matches of P pairs, those that count first, centred, of about unit scale, and K models for each pair.

    points: (4, P, N), rows x0, y0, x1, y1, zero in padded slots. weight: (P, N), likewise. scale: of the kernel in the
    unit of the points, (P,). models: (9, P, K), entries row by row, of about unit scale. counts: which of the caller's
    matches count. Everything is float64 and attached to the caller's graph; the frame is constant. homographies: the
    models F are homographies, not fundamental matrices.
    """

    def __init__(
        self,
        x0: Tensor,
        x1: Tensor,
        weight: Tensor | None,
        mask: Tensor | None,
        F: Tensor,
        scale: float | Tensor,
        homographies: bool = False,
    ) -> None:
        p, n = math.prod(x0.shape[:-2]), x0.shape[-2]
        x = torch.cat([x0, x1], -1).to(torch.float64).reshape(p, n, 4)
        w = torch.ones_like(x[..., 0]) if weight is None else weight.to(torch.float64).reshape(p, n)
        finite = torch.isfinite(x).all(-1) & torch.isfinite(w)
        mask = finite if mask is None else finite & mask.reshape(p, n)
        self.counts = mask.reshape(x0.shape[:-1])
        self._order = order = torch.argsort((~mask).to(torch.uint8), dim=1, stable=True)
        self._mask = mask = mask.gather(1, order)
        inside = mask[..., None]
        x = torch.where(inside, x.gather(1, order[..., None].expand(-1, -1, 4)), 0)
        self.weight = self.ordered(w)
        self.frame = PixelFrame.around(x, mask)
        self.points = torch.where(inside, self.frame.normalized(x), 0).permute(2, 0, 1).contiguous()
        self.scale = torch.as_tensor(scale, dtype=torch.float64, device=x.device).expand(x0.shape[:-2]).reshape(p)
        self.scale = self.scale / self.frame.pixels_per_unit
        is_model = (torch.isfinite(F).flatten(-2).all(-1) & (F != 0).flatten(-2).any(-1))[..., None, None]
        F = torch.where(is_model, F, F.detach())  # no gradient to what is zero or not finite
        matrices = F.to(torch.float64).reshape(p, math.prod(F.shape[x0.dim() - 2 : -2]), 3, 3)
        frame = self.frame
        self._to_pixels = frame.homography_to_pixels if homographies else frame.to_pixels
        from_pixels = frame.homography_from_pixels if homographies else frame.from_pixels
        self.models = as_components(_about_unit(from_pixels(matrices)))

    def ordered(self, weight: Float[Tensor, "*batch n"]) -> Float[Tensor, "p n"]:
        """Values of matches in the caller's order in the order of `points`, 0 in padded slots; float64."""
        flat = weight.to(torch.float64).reshape(self._order.shape)
        return torch.where(self._mask, flat.gather(1, self._order), 0)

    def to_pixels(self, models: Float[Tensor, "9 p k"]) -> Float[Tensor, "p k 3 3"]:
        """Matrices in pixels, of unit norm."""
        return as_matrices(unit(as_components(self._to_pixels(as_matrices(models)))))


@torch.no_grad()
def fitted_by(
    fit: Callable[[Array, Weighted, Array, Array], None],
    models: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    s2: Float[Tensor, "p slots"],
    loss: str,
) -> tuple[Float[Tensor, "9 p k"], Float[Tensor, "p k"]]:
    """Models and costs after fit(models (k, 9), matches, out (k, 9), cost (k,)), a kernel, of each pair, on the CPU.

    s2: squared scales of the loss, one a pair or a match. A model that cannot be fitted comes back as it was, with
    infinite cost.
    """
    start = as_matrices(models).flatten(2).cpu().contiguous().numpy()
    columns, weights = (t.detach().cpu().contiguous().numpy() for t in (points.movedim(1, 0), weight))
    scales = s2.detach().expand_as(weight).cpu().contiguous().numpy()
    out, cost = np.empty_like(start), np.empty(start.shape[:2])
    for p, given in enumerate(start):
        matches = Weighted(columns[p], weights[p], scales[p], LOSSES[loss], loss_table(loss))
        fit(given, matches, out[p], cost[p])
    known = np.isfinite(cost)
    fitted = torch.from_numpy(np.where(known[..., None], out, start)).to(models.device)
    return fitted.permute(2, 0, 1).contiguous(), torch.from_numpy(np.where(known, cost, np.inf)).to(models.device)


def _about_unit(F: Float[Tensor, "p k 3 3"]) -> Float[Tensor, "p k 3 3"]:
    """Matrices scaled by a power of two, which rounds nothing, so that no square under- or overflows."""
    largest = F.detach().abs().amax((-2, -1), keepdim=True)
    usual = (largest > 1e-300) & (largest < 1e300)
    largest = torch.where(usual, largest, 1)
    return F / (largest / (2 * torch.frexp(largest).mantissa))  # the power of two below the largest entry: exact
