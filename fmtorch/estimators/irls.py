"""M-estimators of fundamental matrices by iteratively reweighted least squares: no samples, no random numbers."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float

from fmtorch.core.types import Correspondences, Estimate
from fmtorch.estimators.batch import Estimation, Solution
from fmtorch.estimators.gradients import GraphedMatches, Solved
from fmtorch.estimators.inliers import WithinThreshold, lower_median, residuals_squared, residuals_squared_px
from fmtorch.estimators.models.fundamental import SevenPoint
from fmtorch.estimators.pair import Pair, squared
from fmtorch.estimators.refinement import Fit, Pixels
from fmtorch.geometry import attached_step
from fmtorch.geometry.eight_point import weighted_eight_point
from fmtorch.geometry.levenberg_marquardt import Schedule, Weighted, named_loss
from fmtorch.geometry.refine import refine_kernel, reweighted_kernel
from fmtorch.jit.kernel import Array
from fmtorch.jobs.execution import mapped

DECAY = 0.65  # of the loss's scale, from one iteration to the next, down to the threshold
NOT_DETERMINED = "the matches do not determine a model"


class IterativelyReweighted:
    """The least ``sum_i w_i rho(r_i^2)``, r the Sampson distance, from the weighted 8-point algorithm on all matches.

    w is the prior P(inlier); without one, the rank by ambiguity (1 for the best, falling to 0); without either, 1.
    Each power of w in `starts` gives a first model. From there the scale of the loss shrinks from the residuals'
    own to the threshold, one reweighted fit at each scale (graduated non-convexity, Blake & Zisserman 1987, with
    the 8-point weights of Torr & Murray 1997), so that a redescending loss is not caught in the nearest minimum.
    Of the refined models the one of least cost is the estimate.

    Gradients reach the points and the prior through one attached Gauss-Newton step: those of the optimum.

    Args:
        loss: a name of `geometry.LOSSES`.
        threshold: its scale, Sampson distance, px; a number, or one of each loss by its name.
        starts: powers of w, integers, at least 0.
        iterations: reweighted fits.
        start_scale: the loss's first scale, in robust standard deviations of the residuals under a first model, the
            widest of them.
        refine_iterations: Levenberg-Marquardt steps of the end.
        inlier_threshold: of the inliers reported, Sampson distance, px; null: the threshold.

    Raises:
        ValueError: for a threshold that is not positive, for no starts or a negative one, for an unknown loss, and
            for one without a threshold.
    """

    uses_prior = True
    MIN_MATCHES = 8

    def __init__(
        self, *, loss: str, threshold: float | Mapping[str, float], starts: Sequence[int] = (0, 1, 2, 4, 8, 16),
        iterations: int = 12, start_scale: float = 0.75, refine_iterations: int = 30,
        inlier_threshold: Pixels | None = None,
    ) -> None:  # fmt: skip
        named_loss(loss)
        if isinstance(threshold, Mapping):
            if loss not in threshold:
                raise ValueError(f"threshold has no entry for loss={loss}; there are: {', '.join(threshold)}")
            threshold = threshold[loss]
        if not threshold > 0:
            raise ValueError(f"threshold is {threshold}; it must be positive")
        if not starts or min(starts) < 0:
            raise ValueError(f"starts is {starts}; it must be a list of integers, each at least 0")
        self.loss, self.threshold, self.starts = loss, threshold, sorted(set(starts))
        self.iterations, self.start_scale, self.refine_iterations = iterations, start_scale, refine_iterations
        self.inlier_rule = WithinThreshold(threshold if inlier_threshold is None else inlier_threshold)

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate the fundamental matrices of a batch of pairs; a pair that cannot be solved is `ok=False`."""
        estimation = Estimation(c, seed, SevenPoint(), self.MIN_MATCHES)

        def estimate_part(part: Sequence[int]) -> None:
            with np.errstate(all="ignore"):  # infinite or NaN beyond the range of a float
                for row in estimation.rows(part):
                    estimation.put(row, self.solve(row.pair))

        mapped(estimate_part, estimation.parts)
        return estimation.estimates(self.attached)

    def solve(self, pair: Pair) -> Solution:
        """The model of least cost of one pair."""
        F = self._first(pair)
        if not len(F):
            return Solution(None, 0, reason=NOT_DETERMINED)
        scale = self.threshold / pair.pixels_per_unit
        widest = self.start_scale * 1.4826 * math.sqrt(max(_median(model, pair) for model in F))
        for i in range(self.iterations):
            reweighted_kernel(F, self._weighted(pair, max(widest * DECAY**i, scale)))
        refined, cost = np.empty_like(F), np.empty(len(F))
        refine_kernel(F, self._weighted(pair, scale), Schedule(self.refine_iterations), refined, cost)
        best = int(np.argmin(np.where(np.isfinite(cost), cost, np.inf)))
        if not np.isfinite(cost[best]):
            return Solution(None, 0, reason=NOT_DETERMINED)
        inliers = self.inlier_rule(residuals_squared_px(refined[best], pair), pair)
        return Solution(Fit(refined[best], refined[best], inliers.astype(np.float64)), 0, inliers)

    def attached(self, solved: list[Solved], matches: GraphedMatches) -> Float[torch.Tensor, "p 9"]:
        """As `gradients.Attach`: one Gauss-Newton step, whose gradients are those of the optimum."""
        F = torch.from_numpy(np.stack([s.fit.at for s in solved])).to(matches.points).reshape(-1, 3, 3)
        scale = torch.tensor([self.threshold / s.pair.pixels_per_unit for s in solved]).to(F)
        weight = matches.prior
        if weight is None:
            weight = torch.zeros_like(matches.weight)
            for row, each in zip(weight, solved, strict=True):
                row[: each.pair.count] = torch.from_numpy(_weight(each.pair)).to(row)
        step = attached_step(F, matches.points0, matches.points1, weight, loss=self.loss, scale=scale).flatten(1)
        return step - step.detach()

    def _weighted(self, pair: Pair, scale: float) -> Weighted:
        """The matches with the loss at a scale, in the unit of the points."""
        s2 = np.full(pair.count, squared(scale))
        return Weighted.of(pair.points, pair.cached("irls weight", _weight), s2, self.loss)

    def _first(self, pair: Pair) -> Array:
        """The 8-point algorithm with each power of the weights, where these determine a model, (k, 9)."""
        powers = [np.ones(pair.count)]
        for _ in range(self.starts[-1]):  # NumPy's powers have other last bits on another processor
            powers.append(powers[-1] * pair.cached("irls weight", _weight))
        F, valid = np.empty((len(self.starts), 9)), np.empty(len(self.starts), np.bool_)
        for i, power in enumerate(self.starts):
            valid[i] = weighted_eight_point(pair.points, powers[power], F[i])
        return F[valid]


def _weight(pair: Pair) -> Array:
    """The prior, or the rank by ambiguity, or 1: (n,)."""
    if pair.prior is not None:
        return pair.prior
    if pair.ambiguity is None:
        return np.ones(pair.count)
    rank = np.empty(pair.count, np.float32)  # as torch divides integers
    rank[np.argsort(pair.ambiguity, kind="stable")] = np.arange(pair.count)
    return (np.float32(1) - rank / np.float32(pair.count)).astype(np.float64)


def _median(F: Array, pair: Pair) -> float:
    """The median squared residual of a model (9,), in the unit of the points."""
    r2 = np.empty(pair.count)
    residuals_squared(F, pair.points, 1.0, r2)
    return lower_median(r2)
