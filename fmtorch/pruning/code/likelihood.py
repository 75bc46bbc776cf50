"""The first regression: a smooth likelihood over the match domain, seeded by distinctive matches."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fmtorch.pruning.code.domain import MatchDomain, evenly, predictive_gaussians, spread_centres
from fmtorch.pruning.code.regression import huber_regression


@dataclasses.dataclass(frozen=True)
class LikelihoodField:
    """A function of the match domain that is near 1 where distinctive matches are coherent and near 0 elsewhere.

    ``f = sum_m w_m g(., c_m)`` minimises ``mean_j huber(1 - f(z_j)) + ridge |w|^2`` over the distinctive matches j: all
    are asked to have likelihood 1, but beyond `huber` each pulls with a bounded force, so one alone lifts f by little
    (huber / ridge / their number) while many that agree saturate it at 1.

    ratio, least_seeds, most_seeds: matches below the distance ratio are distinctive; where those are fewer than
    least_seeds, so many of the lowest ratio; where they are more than most_seeds, so many of them, evenly.
    candidates, centres: at most so many seeds are looked at for centres, and so many centres are chosen.
    position, displacement, rotation, scale: widths of the Gaussians, see `predictive_gaussians`; unframed_displacement
    replaces the second where matches have no frames to predict it by.
    """

    ratio: float = 0.8
    least_seeds: int = 200
    most_seeds: int = 4000
    candidates: int = 1500
    centres: int = 300
    position: float = 0.5
    displacement: float = 0.07
    unframed_displacement: float = 0.2
    rotation: float = 0.8
    scale: float = 0.5
    ridge: float = 0.0075
    huber: float = 0.1
    iterations: int = 6

    def __call__(
        self, matches: MatchDomain, quality: Float[Tensor, " n"] | None, *, framed: bool = True
    ) -> Float[Tensor, " n"]:
        """The likelihood of every match; without `quality` every match is distinctive. framed: S is known."""
        seeds = evenly(self.distinctive(matches, quality), self.most_seeds)
        candidates = matches.take(evenly(seeds, self.candidates))
        centres = candidates.take(spread_centres(self._basis(candidates, candidates, framed), self.centres))
        basis = self._basis(matches.take(seeds), centres, framed)
        weights = huber_regression(
            basis,
            torch.ones_like(basis[:, :1]),
            self.ridge * len(seeds) * torch.eye(basis.shape[1], device=basis.device),
            scale=self.huber,
            iterations=self.iterations,
        )
        return torch.cat([self._basis(block, centres, framed) @ weights for block in matches.blocks()])[:, 0]

    def distinctive(self, matches: MatchDomain, quality: Float[Tensor, " n"] | None) -> Int[Tensor, " s"]:
        """Indices of the distinctive matches, in order; NaN is not distinctive unless nothing is."""
        if quality is None:
            return torch.arange(len(matches.p0), device=matches.p0.device)
        seeds = (quality < self.ratio).nonzero()[:, 0]
        if len(seeds) >= self.least_seeds:
            return seeds
        return quality.argsort(stable=True)[: self.least_seeds].sort().values

    def _basis(self, matches: MatchDomain, centres: MatchDomain, framed: bool) -> Float[Tensor, "n m"]:
        return predictive_gaussians(
            matches,
            centres,
            position=self.position,
            displacement=self.displacement if framed else self.unframed_displacement,
            rotation=self.rotation,
            scale=self.scale,
        )
