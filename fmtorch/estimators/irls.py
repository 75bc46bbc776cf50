"""M-estimators of fundamental matrices by iteratively reweighted least squares: no samples, no random numbers."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.compiling import switch
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.estimators.batching import solve_all
from fmtorch.estimators.inliers import WithinThreshold, median_of_matches
from fmtorch.estimators.one_pair import irls as one_pair
from fmtorch.estimators.one_pair.pair import each_pair
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.selection import best_of
from fmtorch.geometry import attached_step, eight_point
from fmtorch.geometry.irls import reweighted
from fmtorch.geometry.refine import refine_components
from fmtorch.geometry.residuals import sampson_squared
from fmtorch.geometry.robust_losses import named_kernel

TILE = 1 << 16  # matches times models of the pairs that are solved together: bounds memory, changes no result
DECAY = 0.65  # of the kernel's scale, from one iteration to the next, down to the threshold


class IterativelyReweighted:
    """The least ``sum_i w_i rho(r_i^2)``, r the Sampson distance, from the weighted 8-point algorithm on all matches.

    w is the prior P(inlier); where there is none, the rank by quality (1 for the best match, falling to 0); where there
    is neither, 1. Each power of w in `starts` gives a first model. From there the scale of the kernel shrinks from the
    residuals' own to the threshold, one reweighted fit at each scale (graduated non-convexity, Blake & Zisserman 1987,
    with the 8-point weights of Torr & Murray 1997), so that a redescending kernel is not caught in the nearest minimum.
    Of the refined models the one of least cost is the estimate.

    Gradients reach the points and the prior through one attached Gauss-Newton step: those of the optimum.

    Args:
        kernel: a name of `geometry.KERNELS`.
        threshold: its scale, Sampson distance, px.
        starts: powers of w, integers, at least 0.
        iterations: reweighted fits.
        start_scale: the kernel's first scale, in robust standard deviations of the residuals under a first model, the
            widest of them.
        refine_iterations: Levenberg-Marquardt steps of the end.
        inlier_threshold: of the inliers reported, Sampson distance, px; null: the threshold.

    Raises:
        ValueError: for a threshold that is not positive, for no starts or a negative one, and for an unknown kernel.
    """

    uses_prior = True
    MIN_MATCHES = 8

    def __init__(
        self,
        *,
        kernel: str,
        threshold: float,
        starts: Sequence[int] = (0, 1, 2, 4, 8, 16),
        iterations: int = 12,
        start_scale: float = 0.75,
        refine_iterations: int = 30,
        inlier_threshold: float | None = None,
    ) -> None:
        if not threshold > 0:
            raise ValueError(f"threshold is {threshold}; it must be positive")
        if not starts or min(starts) < 0:
            raise ValueError(f"starts is {starts}; it must be a list of integers, each at least 0")
        self.kernel, self.robust, self.threshold = kernel, named_kernel(kernel), threshold
        self.starts = sorted(set(starts))
        self.iterations, self.start_scale, self.refine_iterations = iterations, start_scale, refine_iterations
        self.inlier_rule = WithinThreshold(threshold if inlier_threshold is None else inlier_threshold)

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate the fundamental matrices of a batch of pairs; a pair that cannot be solved is `ok=False`."""
        at_once = TILE // (max(1, c.mask.shape[1]) * len(self.starts))
        compiled = c.mask.device.type == "cpu" and switch.available()
        solve = functools.partial(self._solve, self._by_kernels if compiled else self._by_tensors)
        return solve_all(c, seed, self.MIN_MATCHES, solve, "the matches do not determine a model", at_once, compiled)

    def _solve(
        self, optimum: Callable[[NormalizedPairs], tuple[Tensor, Tensor]], pairs: NormalizedPairs
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        with torch.no_grad():
            best, found = optimum(pairs)
        weight, scale = _weight(pairs), self.threshold / pairs.pixels_per_unit
        x0, x1 = pairs.points[:2].permute(1, 2, 0), pairs.points[2:].permute(1, 2, 0)
        estimate = attached_step(best, x0, x1, weight, kernel=self.kernel, scale=scale)
        with torch.no_grad():
            inliers = self.inlier_rule(estimate, pairs)
        return estimate, inliers, found, torch.zeros_like(pairs.count)

    def _by_tensors(self, pairs: NormalizedPairs) -> tuple[Float[Tensor, "p 3 3"], Bool[Tensor, " p"]]:
        """The models of least cost, and which pairs have one."""
        weight, scale = _weight(pairs), self.threshold / pairs.pixels_per_unit
        F, valid = self._first(pairs, weight)
        start = self._first_scale(F, valid, pairs)
        for i in range(self.iterations):
            F = reweighted(F, pairs.points, weight, self.robust, torch.maximum(start * DECAY**i, scale))
        F, cost = refine_components(F, pairs.points, weight, self.kernel, scale, self.refine_iterations)
        some = valid & torch.isfinite(cost)
        return best_of(F, -cost, some).T.reshape(-1, 3, 3), some.any(1)

    def _by_kernels(self, pairs: NormalizedPairs) -> tuple[Float[Tensor, "p 3 3"], Bool[Tensor, " p"]]:
        """The same, pair by pair."""
        decays = [DECAY**i for i in range(self.iterations)]
        found = [
            one_pair.optimum(
                pair, self.kernel, self.threshold / pair.pixels_per_unit, self.starts, self.start_scale, decays,
                self.refine_iterations,
            )
            for pair in each_pair(pairs)
        ]  # fmt: skip
        return torch.from_numpy(np.stack([F for F, _ in found])), torch.tensor([there for _, there in found])

    def _first(self, pairs: NormalizedPairs, weight: Tensor) -> tuple[Float[Tensor, "9 p k"], Bool[Tensor, "p k"]]:
        """The 8-point algorithm on all matches, with each power of the weights, and whether these determine a model."""
        powers = [pairs.mask.to(weight.dtype)]
        for _ in range(self.starts[-1]):
            powers.append(powers[-1] * weight)
        weights = torch.stack([powers[i] for i in self.starts], 1)
        points = pairs.points[:, :, None].expand(-1, -1, len(self.starts), -1)
        F, valid = eight_point(points[:2].movedim(0, -1), points[2:].movedim(0, -1), weights)
        return F.flatten(2).permute(2, 0, 1), valid

    def _first_scale(self, F: Tensor, valid: Tensor, pairs: NormalizedPairs) -> Float[Tensor, " p"]:
        r2 = sampson_squared(F, pairs.points)
        medians = torch.stack([median_of_matches(r2[:, i], pairs)[:, 0] for i in range(r2.shape[1])], 1)
        return self.start_scale * 1.4826 * torch.where(valid, medians, 0).amax(1).sqrt()


def _weight(pairs: NormalizedPairs) -> Float[Tensor, "p n"]:
    """The prior, or the rank by quality, or 1; 0 in padded slots."""
    if pairs.prior is not None:
        return pairs.prior
    if pairs.quality is None:
        return pairs.mask.to(torch.float64)
    order = torch.sort(torch.where(pairs.mask, pairs.quality, torch.inf), dim=1, stable=True).indices
    rank = torch.argsort(order, dim=1)
    return torch.where(pairs.mask, 1 - rank / pairs.count[:, None], 0).to(torch.float64)
