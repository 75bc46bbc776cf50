"""The exchangeable parts of the engine, by the roles and names that configs use; the one place that names them all.

An option that names a part holds its name (``score: msac``), or a mapping of its name and options of its own
(``score: {name: msac, prior_weighted: true}``), or an object: that of a user's `_target_`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from fmtorch.core.options import expect_options
from fmtorch.estimators import focal_search, inliers, pair, preselection, refinement, sampling, scores, search
from fmtorch.estimators.degensac import Degensac
from fmtorch.estimators.final_fits import Adaptive, GaussNewton, LeastSquares, NoFit, UnweightedLeastSquares
from fmtorch.estimators.graph_cut import GraphCut
from fmtorch.estimators.inliers import BetterHalf, RobustDeviations, WithinThreshold
from fmtorch.estimators.lens_search import inverted, minimise_with_lenses
from fmtorch.estimators.models import focal_prior, fundamental, model, posterior, with_focals
from fmtorch.estimators.models.fundamental import EightPoint, Homography, SevenPoint
from fmtorch.estimators.sampling import PriorWeighted, Prosac, Uniform
from fmtorch.estimators.scores import InlierCount, Magsac, Median, Msac, SaturatedGains
from fmtorch.geometry import five_point, homography_refine, levenberg_marquardt
from fmtorch.geometry.homography import four_point
from fmtorch.geometry.refine import refine_kernel
from fmtorch.geometry.seven_point import seven_point_kernel
from fmtorch.geometry.significance import counted_chances, counted_plane_chances, most_significant
from fmtorch.jit.kernel import Kernel

DEFAULT_THRESHOLD_PX = 1.0
Stage = TypeVar("Stage")

PARTS: dict[str, dict[str, Callable[..., Any]]] = {
    "solver": {"seven_point": SevenPoint, "eight_point": EightPoint, "four_point": Homography},
    "sampler": {"uniform": Uniform, "prosac": Prosac, "prior": PriorWeighted},
    "score": {
        "inlier_count": InlierCount,
        "msac": Msac,
        "saturated": SaturatedGains,
        "magsac": Magsac,
        "median": Median,
    },
    "degeneracy": {"degensac": Degensac},
    "local_optimization": {"graph_cut": GraphCut},
    "inliers": {"threshold": WithinThreshold, "median": BetterHalf, "lmeds": RobustDeviations},
    "final": {
        "none": NoFit,
        "least_squares": LeastSquares,
        "unweighted_least_squares": UnweightedLeastSquares,
        "gauss_newton": GaussNewton,
        "adaptive": Adaptive,
    },
}


def takes(role: str, spec: Any, option: str) -> bool:
    """Whether a named part asks the engine for this option."""
    name = spec.get("name") if isinstance(spec, Mapping) else spec
    make = PARTS[role].get(name) if isinstance(name, str) else None
    return make is not None and option in inspect.signature(make).parameters


def part(role: str, spec: Any, **context: Any) -> Any:
    """The part that an option describes, None for none.
    context: what the engine tells its parts; each takes what its constructor names, unless its own options say so.
    Raises ValueError for an unknown name or option, naming those there are."""
    if spec is None or not isinstance(spec, str | Mapping):
        return spec
    name, options = (spec, {}) if isinstance(spec, str) else (spec.get("name"), dict(spec))
    options.pop("name", None)
    if name not in PARTS[role]:
        raise ValueError(f"{role} is {name!r}; it must be one of: {', '.join(PARTS[role])}")
    make = PARTS[role][name]
    known = {key: value for key, value in context.items() if key in inspect.signature(make).parameters}
    expect_options(make, options, f"{role}={name}", known)
    return make(**(known | options))


def stage(options: Stage | Mapping[str, Any] | None, kind: type[Stage]) -> Stage | None:
    """The options of a stage, from a mapping or as they are; None where it is left out."""
    return kind(**options) if isinstance(options, Mapping) else options


def thresholds(
    threshold: float | None, inlier_threshold: float | None, score: Any, inliers: Any, stops: bool, optimization: Any
) -> tuple[float, float]:
    """The thresholds of score and of inliers, px; ValueError where one is given that nothing asks for.
    score, inliers, optimization: as options name these parts. stops: whether there is a stopping rule, which counts
    inliers."""
    by_distance = stops or takes("inliers", inliers, "threshold")
    if inlier_threshold is not None and not by_distance:
        raise ValueError(f"inlier_threshold={inlier_threshold} has no effect: inliers={inliers} takes none")
    scored = takes("score", score, "threshold") or optimization is not None
    if threshold is not None and not scored and (not by_distance or inlier_threshold is not None):
        raise ValueError(f"threshold={threshold} has no effect: score={score} takes none, nor does anything else")
    of_score = DEFAULT_THRESHOLD_PX if threshold is None else threshold
    return of_score, of_score if inlier_threshold is None else inlier_threshold


# Kernels that two processes compile side by side, by what they share, the slowest to compile at both ends

WITH_FOCALS: tuple[Kernel[..., Any], ...] = (
    # Solvers, samples and scores
    five_point.five_point, seven_point_kernel, counted_chances, refinement.near, sampling.draw,
    focal_prior.draw_depths, preselection.draw_by_prior, preselection.best, scores.score_gains, scores.score_saturated,
    pair.normalize_pair, pair.to_pixels, preselection.support, inliers.residuals_squared, inliers.share_within,
    search.merge, scores.saturated_cells, scores.pack, focal_search.posteriors,
    focal_search.distinct_models, focal_search.same_model,
    # Cameras and fits; `evaluate` is called by `minimise` and `refine`
    posterior.centre, posterior.translate, with_focals.gain_without_prior, with_focals.refine_with_prior,
    model.cheirality, most_significant, posterior.nearest_cameras, levenberg_marquardt.evaluate, refine_kernel,
    posterior.minimise, inverted, minimise_with_lenses,
)  # fmt: skip
"""Of an estimator of fundamental matrices with the prior on focal lengths."""

OF_HOMOGRAPHIES: tuple[Kernel[..., Any], ...] = (
    homography_refine.refine_homographies, homography_refine.evaluate_homographies, four_point,
    fundamental.homography_to_pixels, inliers.residuals_squared_homography, refinement.near_homography,
    scores.score_gains_homography, scores.score_saturated_homography, counted_plane_chances,
)  # fmt: skip
"""Of an estimator of homographies, beside those that the former has too."""
