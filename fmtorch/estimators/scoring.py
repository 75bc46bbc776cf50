"""How good a hypothesis is: the residual of every match under every model, turned into one number a model.

Per-match gains are multiples of 2^-10, so their float32 sums are exact (up to 16,384 matches; coarser beyond) and no
tile size, padding or batch can change a score. Larger is better.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.estimators.problem import Problem
from fmtorch.geometry.sigma_consensus import marginal_loss

CPU_TILE = 1 << 18  # elements of one tile: 1 MB of float32, so that the handful of buffers stay in the L2 cache
GPU_TILE = 1 << 26


def sampson_squared(F: Float[Tensor, "9 p m"], points: Float[Tensor, "4 p n"]) -> Float[Tensor, "p m n"]:
    """Squared Sampson distances of every point to every model, component by component.

    Written with in-place products of a column and a row, which torch vectorises, instead of matrix products, whose
    last bits depend on the shape of the batch. Hartley & Zisserman (2004), equation 11.9.
    """
    f = F[..., None]
    x0, y0, x1, y1 = points[:, :, None]
    a0 = (f[0] * x0).addcmul_(f[1], y0).add_(f[2])  # F x0: the epipolar line in image 1
    b0 = (f[3] * x0).addcmul_(f[4], y0).add_(f[5])
    error = (f[6] * x0).addcmul_(f[7], y0).add_(f[8]).addcmul_(a0, x1).addcmul_(b0, y1)
    a1 = (f[0] * x1).addcmul_(f[3], y1).add_(f[6])  # F^T x1: the epipolar line in image 0
    b1 = (f[1] * x1).addcmul_(f[4], y1).add_(f[7])
    slope: Tensor = a0.square_().addcmul_(b0, b0).addcmul_(a1, a1).addcmul_(b1, b1)
    distance: Tensor = error.square_().div_(slope.clamp_min_(torch.finfo(slope.dtype).tiny))
    return distance


@runtime_checkable
class Score(Protocol):
    """Turns squared residuals into scores."""

    def __call__(
        self,
        r2: Float[Tensor, "p m n"],
        live: Bool[Tensor, "p n"],
        prior: Float[Tensor, "p n"] | None,
        unit: Float[Tensor, " p"],
    ) -> Float[Tensor, "p m"]:
        """Scores; r2 in squared normalised units (may be overwritten), `unit` the pixels in one of them."""
        ...


class InlierCount:
    """RANSAC: the number of matches within the threshold (Fischler & Bolles 1981). threshold: Sampson distance, px."""

    def __init__(self, threshold: float) -> None:
        self.threshold = _positive(threshold)

    def __call__(
        self,
        r2: Float[Tensor, "p m n"],
        live: Bool[Tensor, "p n"],
        prior: Float[Tensor, "p n"] | None,
        unit: Float[Tensor, " p"],
    ) -> Float[Tensor, "p m"]:
        """As `Score`."""
        limit = (self.threshold / unit).square().to(r2.dtype)[:, None, None]
        return ((r2 <= limit) & live[:, None]).sum(-1, dtype=torch.float32)


class TruncatedSquares:
    """MSAC: the sum of ``1 - r^2 / t^2`` over the matches within t (Torr & Zisserman 2000), each times its prior.

    threshold: t, Sampson distance, px. prior_weighted: multiply each gain by P(inlier), where there is a prior.
    """

    def __init__(self, threshold: float, prior_weighted: bool = False) -> None:
        self.threshold = _positive(threshold)
        self.prior_weighted = prior_weighted

    def __call__(
        self,
        r2: Float[Tensor, "p m n"],
        live: Bool[Tensor, "p n"],
        prior: Float[Tensor, "p n"] | None,
        unit: Float[Tensor, " p"],
    ) -> Float[Tensor, "p m"]:
        """As `Score`."""
        scale = (unit / self.threshold).square().to(r2.dtype)[:, None, None]
        gain = r2.mul_(scale).neg_().add_(1).clamp_min_(0)
        return _exact_sum(gain.mul_(_weight(live, prior, self.prior_weighted, r2.dtype)))


class GemanMcClure:
    """The sum over matches of ``1 / (1 + r^2 / s^2)``, shifted and scaled to be 1 at r = 0 and 0 from 5 s on.

    Geman & McClure (1987). A narrow peak with a long tail: exact matches decide, and matches with larger noise still
    count, so that one scale serves scenes of different noise. threshold: s, Sampson distance, px. prior_weighted:
    multiply each gain by P(inlier), where there is a prior.
    """

    REACH = 5.0

    def __init__(self, threshold: float, prior_weighted: bool = False) -> None:
        self.threshold = _positive(threshold)
        self.prior_weighted = prior_weighted

    def __call__(
        self,
        r2: Float[Tensor, "p m n"],
        live: Bool[Tensor, "p n"],
        prior: Float[Tensor, "p n"] | None,
        unit: Float[Tensor, " p"],
    ) -> Float[Tensor, "p m"]:
        """As `Score`."""
        scale = (unit / self.threshold).square().to(r2.dtype)[:, None, None]
        rest = 1 / (1 + self.REACH**2)
        gain = r2.mul_(scale).add_(1).reciprocal_().sub_(rest).clamp_min_(0).mul_(1 / (1 - rest))
        return _exact_sum(gain.mul_(_weight(live, prior, self.prior_weighted, r2.dtype)))


def _weight(live: Tensor, prior: Tensor | None, prior_weighted: bool, dtype: torch.dtype) -> Float[Tensor, "p 1 n"]:
    """What each match counts: its prior, or one; nothing in padded slots."""
    return (live if prior is None or not prior_weighted else prior).to(dtype)[:, None]


class SigmaConsensus:
    """MAGSAC++: the likelihood marginalised over the noise scale (Barath et al., CVPR 2020, section 3.2).

    The gain is ``1 - rho(r) / rho(k sigma_max)``, rho as in `sigma_consensus`, tabulated over r^2 as the authors do.
    threshold: k sigma_max, Sampson distance, px.
    """

    ENTRIES = 2048

    def __init__(self, threshold: float) -> None:
        self.threshold = _positive(threshold)
        # Middle of each interval of (r / threshold)^2, and 0 from the threshold on.
        middle = (torch.arange(self.ENTRIES, dtype=torch.float64) + 0.5) / self.ENTRIES
        self._table = torch.cat([self.gain(middle), torch.zeros(1, dtype=torch.float64)]).to(torch.float32)

    @staticmethod
    def gain(squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """1 - rho / rho_max of residuals below the threshold, as a function of (r / threshold)^2."""
        gain: Tensor = 1 - marginal_loss(squared) / marginal_loss(torch.ones_like(squared))
        return gain

    def __call__(
        self,
        r2: Float[Tensor, "p m n"],
        live: Bool[Tensor, "p n"],
        prior: Float[Tensor, "p n"] | None,
        unit: Float[Tensor, " p"],
    ) -> Float[Tensor, "p m"]:
        """As `Score`."""
        scale = (unit / self.threshold).square().mul(self.ENTRIES).to(r2.dtype)[:, None, None]
        entry = r2.mul_(scale).clamp_max_(self.ENTRIES).to(torch.int64)
        return _exact_sum(torch.take(self._table.to(r2.device), entry).mul_(live[:, None]))


class Median:
    """LMedS: minus the median squared residual (Rousseeuw 1984)."""

    def __call__(
        self,
        r2: Float[Tensor, "p m n"],
        live: Bool[Tensor, "p n"],
        prior: Float[Tensor, "p n"] | None,
        unit: Float[Tensor, " p"],
    ) -> Float[Tensor, "p m"]:
        """As `Score`."""
        r2.masked_fill_(~live[:, None], torch.inf)
        rank = median_rank(live.sum(-1)).tolist()
        return torch.stack([-pair.kthvalue(k, dim=-1).values for pair, k in zip(r2, rank, strict=True)])


def median_rank(count: Tensor) -> Tensor:
    """The rank (from 1) of the median of `count` residuals: the lower middle one."""
    return (count + 1) // 2


def _positive(threshold: float) -> float:
    if not threshold > 0:
        raise ValueError(f"threshold is {threshold}; it is a distance in pixels and must be positive")
    return float(threshold)


def _exact_sum(gain: Float[Tensor, "p m n"]) -> Float[Tensor, "p m"]:
    """Sum over matches of gains in [0, 1], each first rounded to a multiple of 2^-10 (coarser beyond 2^14 matches).

    Adding and subtracting 1.5 * 2^(23 - b) rounds a float32 to b fractional bits.
    """
    fractional_bits = min(10, 24 - (gain.shape[-1] - 1).bit_length())
    magic = 1.5 * 2.0 ** (23 - fractional_bits)
    return gain.add_(magic).sub_(magic).sum(-1)


def score_models(
    score: Score,
    F: Float[Tensor, "9 p m"],
    problem: Problem,
    points: Float[Tensor, "4 p n"],
    subset: Tensor | None = None,
) -> Float[Tensor, "p m"]:
    """Scores of the models on all matches, or on the `subset` (P, K) of them, in tiles of bounded size.

    Memory: eight buffers of one tile. Models are float32 in normalised units, as are the points.
    """
    live, prior = problem.live, problem.prior
    if subset is not None:
        points = points.gather(2, subset.expand(4, -1, -1))
        live = live.gather(1, subset)
        prior = None if prior is None else prior.gather(1, subset)
    p, m = F.shape[1:]
    n = points.shape[2]
    limit = GPU_TILE if F.is_cuda else CPU_TILE
    models = max(1, min(m, limit // n))
    pairs = max(1, limit // (n * models))
    scores = torch.empty(p, m, dtype=torch.float32, device=F.device)
    for i in range(0, p, pairs):
        some = slice(i, i + pairs)
        for j in range(0, m, models):
            r2 = sampson_squared(F[:, some, j : j + models], points[:, some])
            one_prior = None if prior is None else prior[some]
            scores[some, j : j + models] = score(r2, live[some], one_prior, problem.unit[some])
    return scores
