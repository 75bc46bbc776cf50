"""The final fit at the scale of the pair's own noise.

One threshold does not suit all pairs: keypoints of a sharp video lie within a fifth of a pixel of their epipolar
lines, those of a hand-held telephone within one. A threshold for the worst lets wrong matches into the fit of the best.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.estimators.parts import residuals_squared
from fmtorch.estimators.problem import Problem
from fmtorch.geometry.refine import attached_step, refine_components

MULTIPLE = 2.0  # of the robust standard deviation: beyond it a match does not count
SMALLEST, LARGEST = 0.3, 2.0  # px, bounds of that distance
UNKNOWN = 1.5  # px, that distance where too few matches tell the noise
LEAST = 15  # matches that tell the noise
LIKELY = 0.3  # matches of a smaller prior do not tell the noise
ITERATIONS = 5  # Levenberg-Marquardt steps


class AdaptiveGaussNewton:
    """Levenberg-Marquardt of the truncated Sampson error at the noise of the inliers, then one attached step.

    The noise is 1.4826 times the median Sampson distance of the inliers (Rousseeuw & Leroy 1987), the truncation
    MULTIPLE times that. The attached step moves nothing at an optimum and has the gradients of the optimum.
    """

    def __call__(
        self, F: Float[Tensor, "p 3 3"], problem: Problem, inliers: Bool[Tensor, "p n"]
    ) -> Float[Tensor, "p 3 3"]:
        """As `FinalFit`."""
        prior = problem.live.to(torch.float64) if problem.prior is None else problem.prior
        with torch.no_grad():
            truncation = noise(residuals_squared(F, problem), inliers & (prior > LIKELY))
            models = F.flatten(1).T[..., None].contiguous()
            scale = truncation / problem.unit
            refined, _ = refine_components(models, problem.points, prior, "truncated", scale, ITERATIONS)
            F = refined[..., 0].T.reshape(-1, 3, 3)
            close = residuals_squared(F, problem) <= truncation.square()[:, None]
        x0, x1 = problem.points[:2].permute(1, 2, 0), problem.points[2:].permute(1, 2, 0)
        weight = torch.where(close & problem.live, prior, 0)
        return attached_step(F, x0, x1, weight, kernel="truncated", scale=torch.inf)


def noise(r2: Float[Tensor, "p n"], inliers: Bool[Tensor, "p n"]) -> Float[Tensor, " p"]:
    """The distance in pixels up to which a match counts, from the squared distances of the inliers."""
    count = inliers.sum(1)
    ordered = torch.where(inliers, r2, torch.inf).sort(1).values
    median = ordered.gather(1, ((count + 1) // 2 - 1).clamp_min(0)[:, None])[:, 0]
    truncation = (MULTIPLE * 1.4826 * median.sqrt()).clamp(SMALLEST, LARGEST)
    return torch.where(count >= LEAST, truncation, UNKNOWN)
