"""How good a hypothesis is: the residual of every match under every model, turned into one number a model.

Per-match gains are rounded to few fractional bits, so that their sums are exact and no tile size, padding or batch can
change a score. Larger is better.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.estimators.problem import Problem
from fmtorch.geometry.residuals import sampson_squared, sampson_squared_of
from fmtorch.geometry.sigma_consensus import marginal_loss

CPU_TILE = 1 << 16  # elements of one tile: 256 KB of float32, so that the handful of buffers stay in the L2 cache
GPU_TILE = 1 << 26
GEMAN_MCCLURE_REACH = 5.0  # scales from which on that gain is zero
GRID = 12  # cells along each side of each image, of saturated gains
VECTORS = 128  # bytes that a processor computes on together, at most: two vectors
LANES = 64  # matches are scored in multiples of it: whole vectors of the processor


def geman_mcclure_gain(squared: Tensor) -> Tensor:
    """``1 / (1 + r^2)`` of squared residuals, shifted and scaled to be 0 from r = GEMAN_MCCLURE_REACH on, in place."""
    rest = 1 / (1 + GEMAN_MCCLURE_REACH**2)
    return squared.add_(1).reciprocal_().sub_(rest).clamp_min_(0).mul_(1 / (1 - rest))


@runtime_checkable
class Score(Protocol):
    """Scores models. prior_weighted: each match counts as much as its prior, where it has one."""

    prior_weighted: bool

    def __call__(
        self,
        F: Float[Tensor, "9 p m"],
        points: Float[Tensor, "4 p n"],
        weight: Float[Tensor, "p n"],
        unit: Float[Tensor, "p slots"],
    ) -> Float[Tensor, "p m"]:
        """Scores of models of points in normalised units, `unit` the pixels in one of them: (p, 1), or (p, n) where
        each match has its own noise, by which its pixels are divided.

        weight: what each match counts, in [0, 1]; zero in padded slots.
        """
        ...


def _check_threshold(threshold: float) -> None:
    if not threshold > 0:
        raise ValueError(f"threshold is {threshold}; it is a distance in pixels and must be positive")


class SummedGains:
    """A score that is the sum over matches of a gain, from 1 at no residual to 0, times P(inlier) if so asked.

    threshold: the scale of the residuals, Sampson distance, px.
    """

    def __init__(self, threshold: float, prior_weighted: bool = False) -> None:
        _check_threshold(threshold)
        self.threshold = float(threshold)
        self.prior_weighted = prior_weighted

    def __call__(self, F: Tensor, points: Tensor, weight: Tensor, unit: Tensor) -> Tensor:
        """As `Score`."""
        scale = (unit / self.threshold).square().to(F.dtype)[:, None]
        gain = self._gain(sampson_squared(F, points).mul_(scale))
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


class SaturatedGains:
    """The sum over grid cells of ``sqrt(sum of P g(r))``, over both images; g is the gain of Geman & McClure.

    Saturates where matches crowd, so that a model which explains the whole image beats one that explains a single
    textured plane. The narrow peak of g tells exact models from those nearby, and its tail lets one scale serve scenes
    of different noise. The grid is that of the box around the matches of weight.
    threshold: the scale, at which a match counts half, Sampson distance, px. unsaturated: the plain sum of g, for a
    first look at few matches.
    """

    def __init__(self, threshold: float, prior_weighted: bool = True) -> None:
        _check_threshold(threshold)
        self.threshold = float(threshold)
        self.prior_weighted = prior_weighted
        self.unsaturated = GemanMcClure(threshold, prior_weighted)

    def __call__(self, F: Tensor, points: Tensor, weight: Tensor, unit: Tensor) -> Tensor:
        """As `Score`."""
        (p, n), m = weight.shape, F.shape[2]
        whole = VECTORS // F.element_size()  # so many models at a time: the rest would be rounded differently
        F = torch.nn.functional.pad(F, (0, -m % whole))
        bits = _fractional_bits(n, F.dtype)
        scale = (unit / self.threshold).square().to(F.dtype)[..., None]
        # (p, n, m): rows of models are added to a cell.
        r2 = sampson_squared_of(F[:, :, None], points[..., None]).mul_(scale)
        gain = _rounded(geman_mcclure_gain(r2).mul_(weight[..., None]), bits).flatten(0, 1)
        first = GRID * GRID * torch.arange(p, device=F.device)[:, None]
        total = torch.zeros_like(F[0])
        for image in (points[:2], points[2:]):
            cell = (_cells(image, weight > 0) + first).flatten()
            sums = gain.new_zeros(p * GRID * GRID, F.shape[2]).index_add_(0, cell, gain)
            total += _rounded(sums.sqrt_(), bits).view(p, GRID * GRID, -1).sum(1)
        return total[:, :m].nan_to_num_(0)


def _cells(points: Float[Tensor, "2 p n"], live: Bool[Tensor, "p n"]) -> Int[Tensor, "p n"]:
    """The cell of each point in a grid over the live points' bounding box."""
    low = torch.where(live, points, torch.inf).amin(-1, keepdim=True)
    high = torch.where(live, points, -torch.inf).amax(-1, keepdim=True)
    share = (points - low) / (high - low).clamp_min(torch.finfo(points.dtype).tiny)
    x: Tensor
    y: Tensor
    x, y = (share * GRID).nan_to_num(0).clamp(0, GRID - 1).to(torch.int64)
    return y * GRID + x


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

    def __call__(self, F: Tensor, points: Tensor, weight: Tensor, unit: Tensor) -> Tensor:
        """As `Score`."""
        live = weight > 0
        r2 = sampson_squared(F, points).masked_fill_(~live[:, None], torch.inf)
        rank = median_rank(live.sum(-1)).tolist()
        return torch.stack([-pair.kthvalue(k, dim=-1).values for pair, k in zip(r2, rank, strict=True)])


def median_rank(count: Tensor) -> Tensor:
    """The rank (from 1) of the median of `count` residuals: the lower middle one."""
    return (count + 1) // 2


def exact_sum(gain: Float[Tensor, "p m n"]) -> Float[Tensor, "p m"]:
    """Sum over matches of gains in [0, 1], each first rounded, in place, so that the sum is exact."""
    return _rounded(gain, _fractional_bits(gain.shape[-1], gain.dtype)).sum(-1)


def _fractional_bits(count: int, dtype: torch.dtype) -> int:
    """Of so many numbers in [0, 1], for their sums to be exact: 10 (fewer beyond 2^14 numbers), 20 in float64."""
    return 20 if dtype == torch.float64 else min(10, 24 - (count - 1).bit_length())


def _rounded(value: Tensor, fractional_bits: int) -> Tensor:
    """Rounded to so many fractional bits, in place: 1.5 * 2^(23 - b) is added to a float32 and subtracted again."""
    magic = 1.5 * 2.0 ** ((52 if value.dtype == torch.float64 else 23) - fractional_bits)
    return value.add_(magic).sub_(magic)


def score_models(
    score: Score,
    F: Float[Tensor, "9 p m"],
    problem: Problem,
    points: Float[Tensor, "4 p n"],
    subset: Int[Tensor, "p k"] | None = None,
    valid: Bool[Tensor, "p m"] | None = None,
) -> Float[Tensor, "p m"]:
    """Scores of the models on all matches, or on the `subset` (P, K) of them, in tiles of bounded size.

    valid: False for slots that hold no model, which must stand last in each pair; they score minus infinity.
    Memory: eight buffers of one tile. Models are float32 in normalised units, as are the points.
    """
    weight = problem.prior if score.prior_weighted and problem.prior is not None else problem.live
    weight, units = weight.to(F.dtype), problem.units
    width = problem.count.tolist()
    if subset is not None:
        points, weight = points.gather(2, subset.expand(4, -1, -1)), weight.gather(1, subset)
        units = units.gather(1, subset) if problem.noise is not None else units
        width = [subset.shape[1]] * len(width)
    p, m = F.shape[1:]
    height = [m] * p if valid is None else valid.sum(1).tolist()
    scores = F.new_full((p, m), -torch.inf)
    limit = GPU_TILE if F.is_cuda else CPU_TILE
    pairs = max(1, limit // (points.shape[2] * max(m, 1)))
    for i in range(0, p, pairs):
        some = slice(i, i + pairs)
        n = min(-(-max(width[some]) // LANES) * LANES, points.shape[2])
        models = max(1, limit // (n * pairs))
        for j in range(0, max(height[some]), models):
            these = slice(j, min(j + models, max(height[some])))
            scores[some, these] = score(F[:, some, these], points[:, some, :n], weight[some, :n], units[some, :n])
    return scores if valid is None else scores.masked_fill_(~valid, -torch.inf)
