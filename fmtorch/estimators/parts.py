"""The exchangeable parts of the engine, by the names that configs use."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.estimators.choice import Choice, SaturatedChoice
from fmtorch.estimators.focal import FocalPrior
from fmtorch.estimators.problem import Problem
from fmtorch.estimators.sampling import PriorWeighted, Prosac, Sampler, Uniform
from fmtorch.estimators.scoring import (
    GemanMcClure,
    InlierCount,
    Median,
    SaturatedGains,
    Score,
    SigmaConsensus,
    TruncatedSquares,
    median_rank,
)
from fmtorch.geometry.minimal import eight_point_components, seven_point_components
from fmtorch.geometry.orientation import consistently_oriented
from fmtorch.geometry.refine import RANK_TWO_ALREADY, refine_components
from fmtorch.geometry.residuals import sampson_squared

T = TypeVar("T")


def part(role: str, name: str, choices: Mapping[str, T]) -> T:
    """The named choice; a ValueError that lists the choices where there is none of that name."""
    if name not in choices:
        raise ValueError(f"{role} is {name!r}; it must be one of: {', '.join(choices)}")
    return choices[name]


@runtime_checkable
class Solver(Protocol):
    """A minimal solver: `size` matches in, up to a few models out."""

    size: int

    def __call__(self, sample: Float[Tensor, "4 size p s"]) -> tuple[Float[Tensor, "9 p m"], Bool[Tensor, "p m"]]:
        """Models and which of them exist, in the order of the samples."""
        ...


class SevenPoint:
    """Up to three models from seven matches."""

    size = 7

    def __call__(self, sample: Float[Tensor, "4 size p s"]) -> tuple[Float[Tensor, "9 p m"], Bool[Tensor, "p m"]]:
        """As `Solver`: the three roots of one sample stand together."""
        F, valid = seven_point_components(sample)
        valid = valid & consistently_oriented(F, sample[:, :, None])
        return F.permute(0, 2, 3, 1).flatten(2).contiguous(), valid.permute(1, 2, 0).flatten(1).contiguous()


class EightPoint:
    """One model from eight matches."""

    size = 8

    def __call__(self, sample: Float[Tensor, "4 size p s"]) -> tuple[Float[Tensor, "9 p m"], Bool[Tensor, "p m"]]:
        """As `Solver`."""
        F, valid = eight_point_components(sample)
        return F, valid & consistently_oriented(F, sample)


def residuals_squared(F: Float[Tensor, "p 3 3"], problem: Problem) -> Float[Tensor, "p n"]:
    """Squared Sampson distances in squared pixels, float64."""
    r2 = sampson_squared(F.flatten(1).T[..., None].contiguous(), problem.points)[:, 0]
    return r2 * problem.unit.square()[:, None]


class WithinThreshold:
    """Inliers are the matches within the threshold (Sampson distance, px)."""

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold

    def __call__(self, F: Float[Tensor, "p 3 3"], problem: Problem) -> Bool[Tensor, "p n"]:
        """The inliers of each pair's model."""
        return (residuals_squared(F, problem) <= self.threshold**2) & problem.live


def median_of_live(r2: Float[Tensor, "p n"], problem: Problem) -> Float[Tensor, "p 1"]:
    """The median of the live residuals of each pair."""
    ordered = torch.where(problem.live, r2, torch.inf).sort(1).values
    return ordered.gather(1, median_rank(problem.count)[:, None] - 1)


class BetterHalf:
    """Inliers are the matches at or below the median residual, as MATLAB's LMedS reports them."""

    def __init__(self, threshold: float) -> None:
        pass

    def __call__(self, F: Float[Tensor, "p 3 3"], problem: Problem) -> Bool[Tensor, "p n"]:
        """The inliers of each pair's model."""
        r2 = residuals_squared(F, problem)
        return (r2 <= median_of_live(r2, problem)) & problem.live


class RobustDeviations:
    """Inliers lie within 2.5 robust standard deviations (Rousseeuw & Leroy 1987, chapter 5; Zhang 1998)."""

    PARAMETERS = 7

    def __init__(self, threshold: float) -> None:
        pass

    def __call__(self, F: Float[Tensor, "p 3 3"], problem: Problem) -> Bool[Tensor, "p n"]:
        """The inliers of each pair's model."""
        r2 = residuals_squared(F, problem)
        spare = (problem.count - self.PARAMETERS).clamp_min(1)[:, None]
        sigma = 1.4826 * (1 + 5 / spare) * median_of_live(r2, problem).sqrt()
        return (r2 <= (2.5 * sigma).square()) & problem.live


class Refinement:
    """Levenberg-Marquardt of the robust Sampson error, weighted by prior and noise where there are any."""

    def __init__(self, kernel: str, threshold: float, iterations: int) -> None:
        self.kernel, self.threshold, self.iterations = kernel, threshold, iterations

    def __call__(self, F: Float[Tensor, "9 p k"], problem: Problem) -> Float[Tensor, "9 p k"]:
        """The refined models."""
        scale = self.threshold / problem.units
        return refine_components(
            F, problem.points, problem.weight(), self.kernel, scale, self.iterations, squarings=RANK_TWO_ALREADY
        )[0]


SAMPLERS: dict[str, Callable[[], Sampler]] = {"uniform": Uniform, "prosac": Prosac, "prior": PriorWeighted}
SOLVERS: dict[str, Callable[[], Solver]] = {"seven_point": SevenPoint, "eight_point": EightPoint}
SCORES: dict[str, Callable[[float], Score]] = {
    "inlier_count": InlierCount,
    "msac": TruncatedSquares,
    "prior_msac": lambda threshold: TruncatedSquares(threshold, prior_weighted=True),
    "geman_mcclure": GemanMcClure,
    "prior_geman_mcclure": lambda threshold: GemanMcClure(threshold, prior_weighted=True),
    "saturated": lambda threshold: SaturatedGains(threshold, prior_weighted=False),
    "prior_saturated": SaturatedGains,
    "magsac": SigmaConsensus,
    "median": lambda threshold: Median(),
}
INLIER_RULES: dict[str, Callable[[float], Callable[[Tensor, Problem], Tensor]]] = {
    "threshold": WithinThreshold,
    "median": BetterHalf,
    "lmeds": RobustDeviations,
}
CHOICES: dict[str, Callable[[float, int, int], Choice]] = {
    "saturated": lambda scale, iterations, most: SaturatedChoice(scale),
    "focal": FocalPrior,
    "focal_any_side": functools.partial(FocalPrior, cheirality=False),
}
