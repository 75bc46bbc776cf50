"""How good a hypothesis is: the residual of every match under every model, turned into one number a model.

Per-match gains are rounded to few fractional bits, so that their sums are exact and no tile size, padding or batch can
change a score. Larger is better.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.geometry.arithmetic import exact_sum
from fmtorch.geometry.residuals import sampson_squared
from fmtorch.geometry.sigma_consensus import marginal_loss

CPU_TILE = 1 << 16  # elements of one tile: 256 KB of float32, so that the handful of buffers stay in the L2 cache
GPU_TILE = 1 << 26
GEMAN_MCCLURE_REACH = 5.0  # scales from which on that gain is zero
LANES = 64  # matches are scored in multiples of it: whole vectors of the processor


def geman_mcclure_gain(squared: Tensor) -> Tensor:
    """``1 / (1 + r^2)`` of squared residuals, shifted and scaled to be 0 from r = GEMAN_MCCLURE_REACH on, in place."""
    rest = 1 / (1 + GEMAN_MCCLURE_REACH**2)
    return squared.add_(1).reciprocal_().sub_(rest).clamp_min_(0).mul_(1 / (1 - rest))


@runtime_checkable
class Score(Protocol):
    """Scores models. prior_weighted: each match counts as much as its prior, where it has one.

    One may have a `first_look`, another score by which models are compared on few matches.
    """

    prior_weighted: bool

    def __call__(
        self,
        F: Float[Tensor, "9 p m"],
        points: Float[Tensor, "4 p n"],
        weight: Float[Tensor, "p n"],
        scale: Float[Tensor, "p slots"],
    ) -> Float[Tensor, "p m"]:
        """Scores of models of points in normalised units, `scale` the pixels in one of them: (p, 1), or (p, n) where
        each match has its own noise, by which its pixels are divided.

        weight: what each match counts, in [0, 1]; zero in padded slots.
        """
        ...


def check_threshold(threshold: float) -> None:
    """Raise ValueError for what is no distance."""
    if not threshold > 0:
        raise ValueError(f"threshold is {threshold}; it is a distance in pixels and must be positive")


class SummedGains:
    """A score that is the sum over matches of a gain, from 1 at no residual to 0, times P(inlier) if so asked.

    threshold: the scale of the residuals, Sampson distance, px.
    """

    def __init__(self, threshold: float, prior_weighted: bool = False) -> None:
        check_threshold(threshold)
        self.threshold = float(threshold)
        self.prior_weighted = prior_weighted

    def __call__(self, F: Tensor, points: Tensor, weight: Tensor, scale: Tensor) -> Tensor:
        """As `Score`."""
        squared = (scale / self.threshold).square().to(F.dtype)[:, None]
        gain = self._gain(sampson_squared(F, points).mul_(squared))
        return exact_sum(gain.mul_(weight[:, None]))

    def _gain(self, squared: Float[Tensor, "p m n"]) -> Float[Tensor, "p m n"]:
        """The gains at squared residuals in units of the threshold; these may be overwritten."""
        raise NotImplementedError


class InlierCount(SummedGains):
    """RANSAC: the number of matches within the threshold (Fischler & Bolles 1981)."""

    def _gain(self, squared: Float[Tensor, "p m n"]) -> Float[Tensor, "p m n"]:
        return squared.le_(1)


class TruncatedSquares(SummedGains):
    """MSAC: the sum of ``1 - r^2 / t^2`` over the matches within the threshold t (Torr & Zisserman 2000)."""

    def _gain(self, squared: Float[Tensor, "p m n"]) -> Float[Tensor, "p m n"]:
        return squared.neg_().add_(1).clamp_min_(0)


class GemanMcClure(SummedGains):
    """The sum over matches of ``1 / (1 + r^2 / s^2)``, shifted and scaled to be 1 at r = 0 and 0 from 5 s on.

    Geman & McClure (1987); s is the threshold. A narrow peak with a long tail: exact matches decide, and matches with
    larger noise still count, so that one scale serves scenes of different noise.
    """

    def _gain(self, squared: Float[Tensor, "p m n"]) -> Float[Tensor, "p m n"]:
        return geman_mcclure_gain(squared)


class SigmaConsensus(SummedGains):
    """MAGSAC++: the likelihood marginalised over the noise scale (Barath et al., CVPR 2020, section 3.2).

    The gain is ``1 - rho(r) / rho(k sigma_max)``, rho as in `sigma_consensus`, tabulated over r^2 as the authors do.
    threshold: k sigma_max, Sampson distance, px.
    """

    ENTRIES = 2048

    def __init__(self, threshold: float) -> None:
        super().__init__(threshold)
        # Middle of each interval of (r / threshold)^2, and 0 from the threshold on.
        middle = (torch.arange(self.ENTRIES, dtype=torch.float64) + 0.5) / self.ENTRIES
        self._table = torch.cat([self.gain(middle), torch.zeros(1, dtype=torch.float64)]).to(torch.float32)

    @property
    def table(self) -> Float[Tensor, " entries"]:
        """The gains of `ENTRIES` intervals of (r / threshold)^2, and 0 from the threshold on; float32."""
        return self._table

    @staticmethod
    def gain(squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """1 - rho / rho_max of residuals below the threshold, as a function of (r / threshold)^2."""
        gain: Tensor = 1 - marginal_loss(squared) / marginal_loss(torch.ones_like(squared))
        return gain

    def _gain(self, squared: Float[Tensor, "p m n"]) -> Float[Tensor, "p m n"]:
        entry = squared.mul_(self.ENTRIES).clamp_max_(self.ENTRIES).to(torch.int32)
        return torch.index_select(self._table.to(squared.device), 0, entry.flatten()).view_as(squared)


class Median:
    """LMedS: minus the median squared residual (Rousseeuw 1984)."""

    prior_weighted = False

    def __call__(self, F: Tensor, points: Tensor, weight: Tensor, scale: Tensor) -> Tensor:
        """As `Score`."""
        mask = weight > 0
        r2 = sampson_squared(F, points).masked_fill_(~mask[:, None], torch.inf)
        rank = median_rank(mask.sum(-1)).tolist()
        return torch.stack([-pair.kthvalue(k, dim=-1).values for pair, k in zip(r2, rank, strict=True)])


def median_rank(count: Tensor) -> Tensor:
    """The rank (from 1) of the median of `count` residuals: the lower middle one."""
    return (count + 1) // 2


def score_models(
    score: Score,
    F: Float[Tensor, "9 p m"],
    pairs: NormalizedPairs,
    valid: Bool[Tensor, "p m"] | None = None,
) -> Float[Tensor, "p m"]:
    """Scores of the models on all matches, in tiles of bounded size.

    valid: False for slots that hold no model, which must stand last in each pair; they score minus infinity.
    Memory: eight buffers of one tile. Scores are computed in the type of the models.
    """
    points = pairs.points32 if F.dtype == torch.float32 else pairs.points.detach()
    weight = pairs.prior if score.prior_weighted and pairs.prior is not None else pairs.mask
    weight, scale = weight.to(F.dtype), pairs.scale
    width = pairs.count.tolist()
    p, m = F.shape[1:]
    height = [m] * p if valid is None else valid.sum(1).tolist()
    scores = F.new_full((p, m), -torch.inf)
    limit = GPU_TILE if F.is_cuda else CPU_TILE
    at_once = max(1, limit // (points.shape[2] * max(m, 1)))
    for i in range(0, p, at_once):
        some = slice(i, i + at_once)
        n = min(-(-max(width[some]) // LANES) * LANES, points.shape[2])
        models = max(1, limit // (n * at_once))
        for j in range(0, max(height[some]), models):
            these = slice(j, min(j + models, max(height[some])))
            scores[some, these] = score(F[:, some, these], points[:, some, :n], weight[some, :n], scale[some, :n])
    return scores if valid is None else scores.masked_fill_(~valid, -torch.inf)
