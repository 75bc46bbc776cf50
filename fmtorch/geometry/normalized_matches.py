"""The way into the solvers: leading shapes flattened, masked slots moved to the end, coordinates normalised."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.rank2_manifold import unit
from fmtorch.geometry.reduce import matmul3


class NormalizedMatches:
    """Matches of P pairs, those that count first, centred, of about unit scale, and K models for each pair.

    points: (4, P, N), rows x0, y0, x1, y1, zero in padded slots. weight: (P, N), likewise. scale: of the kernel in the
    unit of the points, (P,). models: (9, P, K), entries row by row, of about unit scale. counts: which of the caller's
    matches count. Everything is float64 and attached to the caller's graph; centre and unit are constants.
    """

    def __init__(
        self,
        x0: Tensor,
        x1: Tensor,
        weight: Tensor | None,
        mask: Tensor | None,
        F: Tensor,
        scale: float | Tensor,
    ) -> None:
        p, n = math.prod(x0.shape[:-2]), x0.shape[-2]
        x = torch.cat([x0, x1], -1).to(torch.float64).reshape(p, n, 4)
        w = torch.ones_like(x[..., 0]) if weight is None else weight.to(torch.float64).reshape(p, n)
        live = torch.isfinite(x).all(-1) & torch.isfinite(w)
        if mask is not None:
            live = live & mask.reshape(p, n)
        self.counts = live.reshape(x0.shape[:-1])
        self._order = order = torch.argsort((~live).to(torch.uint8), dim=1, stable=True)
        self._live = live = live.gather(1, order)
        inside = live[..., None]
        x = torch.where(inside, x.gather(1, order[..., None].expand(-1, -1, 4)), 0)
        self.weight = self.ordered(w)
        low = torch.where(inside, x.detach(), torch.inf).amin(1) if n else x.new_full((len(x), 4), torch.inf)
        high = torch.where(inside, x.detach(), -torch.inf).amax(1) if n else -low
        some = live.any(1)
        self.centre = torch.where(some[:, None], (low + high) / 2, 0)
        half = torch.where(some, ((high - low) / 2).amax(-1), 1)
        # A power of two, so that scaling rounds nothing; 1 where all points coincide.
        self.unit = torch.where(half > 0, torch.exp2(torch.ceil(torch.log2(half.clamp(1e-300, 1e300)))), 1)
        scaled = (x - self.centre[:, None]) / self.unit[:, None, None]
        self.points = torch.where(inside, scaled, 0).permute(2, 0, 1).contiguous()
        self.scale = torch.as_tensor(scale, dtype=torch.float64, device=x.device).expand(x0.shape[:-2]).reshape(p)
        self.scale = self.scale / self.unit
        A0, A1 = self._affinity(0), self._affinity(2)
        is_model = (torch.isfinite(F).flatten(-2).all(-1) & (F != 0).flatten(-2).any(-1))[..., None, None]
        F = torch.where(is_model, F, F.detach())  # no gradient to what is zero or not finite
        matrices = F.to(torch.float64).reshape(p, math.prod(F.shape[x0.dim() - 2 : -2]), 3, 3)
        self.models = _flat(_about_unit(matmul3(matmul3(A1.mT, matrices), A0)))

    def ordered(self, weight: Float[Tensor, "*batch n"]) -> Float[Tensor, "p n"]:
        """Values of matches in the caller's order in the order of `points`, 0 in padded slots; float64."""
        flat = weight.to(torch.float64).reshape(self._order.shape)
        return torch.where(self._live, flat.gather(1, self._order), 0)

    def to_pixels(self, models: Float[Tensor, "9 p k"]) -> Float[Tensor, "p k 3 3"]:
        """Matrices in pixels, of unit norm."""
        T0, T1 = self._similarity(0), self._similarity(2)
        F = matmul3(matmul3(T1.mT, matrices(models)), T0)
        return matrices(unit(_flat(F)))

    def _affinity(self, first: int) -> Float[Tensor, "p 1 3 3"]:
        """From normalised to pixel coordinates of one image."""
        A = torch.diag_embed(torch.stack([self.unit, self.unit, torch.ones_like(self.unit)], -1))
        A[:, :2, 2] = self.centre[:, first : first + 2]
        return A[:, None]

    def _similarity(self, first: int) -> Float[Tensor, "p 1 3 3"]:
        """From pixel to normalised coordinates of one image."""
        T = torch.diag_embed(torch.stack([1 / self.unit, 1 / self.unit, torch.ones_like(self.unit)], -1))
        T[:, :2, 2] = -self.centre[:, first : first + 2] / self.unit[:, None]
        return T[:, None]


def _flat(F: Float[Tensor, "p k 3 3"]) -> Float[Tensor, "9 p k"]:
    return F.flatten(2).permute(2, 0, 1).contiguous()


def _about_unit(F: Float[Tensor, "p k 3 3"]) -> Float[Tensor, "p k 3 3"]:
    """Matrices scaled by a power of two, which rounds nothing, so that no square under- or overflows."""
    largest = F.detach().abs().amax((-2, -1), keepdim=True)
    usual = (largest > 1e-300) & (largest < 1e300)
    return F / torch.exp2(torch.floor(torch.log2(torch.where(usual, largest, 1))))


def matrices(F: Float[Tensor, "9 p k"]) -> Float[Tensor, "p k 3 3"]:
    """Components as matrices."""
    return F.permute(1, 2, 0).reshape(*F.shape[1:], 3, 3)
