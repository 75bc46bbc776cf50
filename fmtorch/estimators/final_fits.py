"""Final fits: from the best hypothesis and its inliers to the estimate, attached to the graph of the points."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.estimators.choice import TwoCameras
from fmtorch.estimators.focal import fit_focal
from fmtorch.estimators.parts import residuals_squared
from fmtorch.estimators.problem import Problem
from fmtorch.geometry import eight_point
from fmtorch.geometry.refine import RANK_TWO_ALREADY, attached_step, refine_components

MULTIPLE = 2.0  # of the robust standard deviation: beyond it a match does not count
SMALLEST, LARGEST = 0.3, 2.0  # px, bounds of that distance
UNKNOWN = 1.5  # px, that distance where too few matches tell the noise
LEAST = 15  # matches that tell the noise
LIKELY = 0.3  # matches of a smaller prior do not tell the noise
ITERATIONS = 8  # Levenberg-Marquardt steps, at most
DAMPING = 1e-6  # at first: the start is near the optimum, and its weakest directions take long steps
DOUBT = 4.0  # what an optimum without prior may gain, in logarithms of the likelihood, before it is taken instead
FOCAL_ITERATIONS = 5  # the same, where cameras are assumed: these start nearer
LIKELIHOOD_TOLERANCE = 0.05  # of its logarithm: a fifth of a standard deviation more or less
TOLERANCE = 1e-4  # share of the cost: a smaller gain ends the fit


@runtime_checkable
class FinalFit(Protocol):
    """Turns the best hypothesis and its inliers into the estimate; attached to the graph of the points."""

    def __call__(
        self,
        F: Float[Tensor, "p 3 3"],
        problem: Problem,
        inliers: Bool[Tensor, "p n"],
        cameras: TwoCameras | None = None,
    ) -> Float[Tensor, "p 3 3"]:
        """The estimate in normalised units."""
        ...


class NoFit:
    """The best hypothesis as it is."""

    def __call__(
        self,
        F: Float[Tensor, "p 3 3"],
        problem: Problem,
        inliers: Bool[Tensor, "p n"],
        cameras: TwoCameras | None = None,
    ) -> Float[Tensor, "p 3 3"]:
        """As `FinalFit`."""
        return F


class LeastSquares:
    """The normalised 8-point algorithm on the inliers; the hypothesis itself where they do not determine one.

    weighted: where there is a prior, an inlier counts prior / noise^2, as in the other fits, and gradients reach the
    prior; where there is none, or if not weighted, all count alike. On 60 pairs of castle-P19 and fox with the prior of
    frame consistency, three seeds, weights raise AUC@0.05 by 0.9 +- 0.4 (`ransac`), 0.9 +- 0.4 (`msac`) and 1.5 +- 0.6
    points (`lmeds`, standard errors over pairs); without the noise by 0.4, 0.6 and 1.0.
    """

    def __init__(self, *, weighted: bool = True) -> None:
        self.weighted = weighted

    def __call__(
        self,
        F: Float[Tensor, "p 3 3"],
        problem: Problem,
        inliers: Bool[Tensor, "p n"],
        cameras: TwoCameras | None = None,
    ) -> Float[Tensor, "p 3 3"]:
        """As `FinalFit`."""
        x0, x1 = problem.points[:2].permute(1, 2, 0), problem.points[2:].permute(1, 2, 0)
        weight = inliers.to(torch.float64)
        if self.weighted and problem.prior is not None:
            weight = torch.where(inliers, problem.weight(), 0)
        fitted, valid = eight_point(x0, x1, weight)
        return torch.where(valid[:, None, None], fitted, F)


class GaussNewton:
    """One attached Gauss-Newton step of the Sampson error at the refined model, on its inliers, by prior and noise.

    At an optimum it moves nothing, and its gradient is that of the optimum (implicit function theorem).
    """

    def __call__(
        self,
        F: Float[Tensor, "p 3 3"],
        problem: Problem,
        inliers: Bool[Tensor, "p n"],
        cameras: TwoCameras | None = None,
    ) -> Float[Tensor, "p 3 3"]:
        """As `FinalFit`."""
        x0, x1 = problem.points[:2].permute(1, 2, 0), problem.points[2:].permute(1, 2, 0)
        weight = torch.where(inliers, problem.weight(), 0)
        return attached_step(F, x0, x1, weight, kernel="truncated", scale=torch.inf)


class AdaptiveGaussNewton:
    """Levenberg-Marquardt of the truncated Sampson error at the noise of the inliers; gradients as of an attached step.

    One threshold does not suit all pairs: keypoints of a sharp video lie within a fifth of a pixel of their epipolar
    lines, those of a hand-held telephone within one. A threshold for the worst lets wrong matches into the fit of the
    best: on rendered training scenes this fit raises AUC@0.05 from 66.8 to 74.2 (indoor) and from 78.2 to 85.3
    (driving) and changes nothing on castle-P19 and fox.
    The noise is 1.4826 times the median Sampson distance of the inliers (Rousseeuw & Leroy 1987), the truncation
    MULTIPLE times that. One step more, attached to the graph, has the gradients of the optimum: they are given to the
    estimate, whose value stays the same whether anybody asks for gradients or not.
    """

    def __call__(
        self,
        F: Float[Tensor, "p 3 3"],
        problem: Problem,
        inliers: Bool[Tensor, "p n"],
        cameras: TwoCameras | None = None,
    ) -> Float[Tensor, "p 3 3"]:
        """As `FinalFit`."""
        weight = problem.weight()
        likely = inliers if problem.prior is None else inliers & (problem.prior > LIKELY)
        attached = problem.points.requires_grad or weight.requires_grad
        with torch.no_grad():
            truncation = noise(_in_noises(F, problem), likely)
            free, calibrated = torch.ones_like(problem.live[:, 0]), None
            if cameras is not None and bool(cameras.known.any()):
                (k,) = cameras.known.nonzero(as_tuple=True)
                t = truncation[k]
                calibrated = fit_focal(
                    cameras[k], problem.only(k), t, t / MULTIPLE, FOCAL_ITERATIONS, LIKELIHOOD_TOLERANCE
                )
                trusted = (calibrated.gain <= DOUBT) & torch.isfinite(calibrated.F).flatten(1).all(1)
                free = free.index_copy(0, k, ~trusted)
                F = F.index_copy(0, k, torch.where(trusted[:, None, None], calibrated.F, F[k]))
            (f,) = free.nonzero(as_tuple=True)
            if len(f):
                F = F.index_copy(0, f, self._free(F[f], problem.only(f), truncation[f]))
            if not attached:
                return F
            close = _in_noises(F, problem) <= truncation.square()[:, None]
        x0, x1 = problem.points[:2].permute(1, 2, 0), problem.points[2:].permute(1, 2, 0)
        counted = torch.where(close & problem.live, weight, 0)
        step = attached_step(F, x0, x1, counted, kernel="truncated", scale=torch.inf)
        step = step - step.detach()
        if calibrated is not None:
            own = calibrated.attached_step(problem.only(k), close[k])
            step = step.index_copy(0, k, torch.where(trusted[:, None, None], own, step[k]))
        return F + step

    def _free(
        self, F: Float[Tensor, "p 3 3"], problem: Problem, truncation: Float[Tensor, " p"]
    ) -> Float[Tensor, "p 3 3"]:
        """The optimum without prior."""
        models = F.flatten(1).T[..., None].contiguous()
        scale = truncation[:, None] / problem.units
        refined, _ = refine_components(
            models,
            problem.points,
            problem.weight(),
            "truncated",
            scale,
            ITERATIONS,
            TOLERANCE,
            RANK_TWO_ALREADY,
            DAMPING,
        )
        return refined[..., 0].T.reshape(-1, 3, 3)


def _in_noises(F: Float[Tensor, "p 3 3"], problem: Problem) -> Float[Tensor, "p n"]:
    """Squared Sampson distances in squared pixels, of matches of usual noise."""
    r2 = residuals_squared(F, problem)
    return r2 if problem.noise is None else r2 / problem.noise.square()


def noise(r2: Float[Tensor, "p n"], inliers: Bool[Tensor, "p n"]) -> Float[Tensor, " p"]:
    """The distance in pixels up to which a match counts, from the squared distances of the inliers."""
    count = inliers.sum(1)
    ordered = torch.where(inliers, r2, torch.inf).sort(1).values
    median = ordered.gather(1, ((count + 1) // 2 - 1).clamp_min(0)[:, None])[:, 0]
    truncation = (MULTIPLE * 1.4826 * median.sqrt()).clamp(SMALLEST, LARGEST)
    return torch.where(count >= LEAST, truncation, UNKNOWN)


FINAL_FITS: dict[str, Callable[[], FinalFit]] = {
    "none": NoFit,
    "least_squares": LeastSquares,
    "unweighted_least_squares": functools.partial(LeastSquares, weighted=False),
    "gauss_newton": GaussNewton,
    "adaptive": AdaptiveGaussNewton,
}
