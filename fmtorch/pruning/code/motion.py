"""The second regression: a smooth affine motion through the likely matches."""

from __future__ import annotations

import dataclasses
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.pruning.code.domain import MatchDomain, evenly, gaussians, spread_centres
from fmtorch.pruning.code.regression import huber_regression

_FREE = 1e-3  # the common affine motion's share of the ridge
MIN_MATCHES = 8  # likely matches without which there is no motion


@dataclasses.dataclass(frozen=True)
class SmoothMotion:
    """The displacement as one affine motion plus, around each of some centres, an affine motion that fades away.

    ``d(z) = A [p0, 1] + sum_m g(z, c_m) A_m [(p0 - c_m) / position, 1]`` minimises ``sum_j huber(|d_j - d(z_j)|) +
    ridge sum |A_m|^2`` over the likely matches j. The Gaussians g are over position and, widely, over displacement, so
    that neighbouring surfaces may move differently.

    most_matches: so many likely matches take part, evenly. candidates, centres: as in the likelihood.
    position, displacement: widths; huber: in the same units, those of the normalised coordinates.
    """

    most_matches: int = 4000
    candidates: int = 1000
    centres: int = 64
    position: float = 0.5
    displacement: float = 0.7
    ridge: float = 0.5
    huber: float = 0.02
    iterations: int = 5

    def __call__(self, matches: MatchDomain, likely: Bool[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Distance of every match's partner from where the motion puts it; infinite where too few are likely."""
        members = likely.nonzero()[:, 0]
        if len(members) < MIN_MATCHES:
            return torch.full_like(matches.p0[:, 0], math.inf)
        fitted = matches.take(evenly(members, self.most_matches))
        centres = fitted.take(self._centres(fitted))
        basis = self._basis(fitted, centres)
        penalty = torch.full_like(basis[0], self.ridge)
        penalty[:3] *= _FREE
        motion = huber_regression(
            basis, fitted.p1 - fitted.p0, torch.diag(penalty), scale=self.huber, iterations=self.iterations
        )
        residuals = [
            (block.p1 - block.p0 - self._basis(block, centres) @ motion).square().sum(1).sqrt()
            for block in matches.blocks()
        ]
        return torch.cat(residuals)

    def _domain(self, matches: MatchDomain) -> Float[Tensor, "n 4"]:
        return torch.cat([matches.p0 / self.position, (matches.p1 - matches.p0) / self.displacement], 1)

    def _centres(self, matches: MatchDomain) -> Int[Tensor, " m"]:
        candidates = evenly(torch.arange(len(matches.p0), device=matches.p0.device), self.candidates)
        z = self._domain(matches)[candidates]
        return candidates[spread_centres(gaussians(z, z), self.centres)]

    def _basis(self, matches: MatchDomain, centres: MatchDomain) -> Float[Tensor, "n k"]:
        g = gaussians(self._domain(matches), self._domain(centres))
        dx, dy = ((matches.p0[:, None, i] - centres.p0[None, :, i]) / self.position for i in (0, 1))
        return torch.cat([torch.ones_like(g[:, :1]), matches.p0, g, g * dx, g * dy], 1)
