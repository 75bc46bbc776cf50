"""Kernels that two processes compile side by side, by what they share, the slowest to compile at both ends."""

from __future__ import annotations

from typing import Any

from fmtorch.estimators import focal_search, inliers, pair, preselection, refinement, sampling, scores, search
from fmtorch.estimators import preselection as support
from fmtorch.estimators import scores as saturated
from fmtorch.estimators import scores as scored_matches
from fmtorch.estimators.models import focal_prior, homography, model, posterior, with_focals
from fmtorch.estimators.models import posterior as cameras
from fmtorch.geometry import five_point, homography_refine, levenberg_marquardt
from fmtorch.geometry.homography import four_point
from fmtorch.geometry.refine import refine_kernel
from fmtorch.geometry.seven_point import seven_point_kernel
from fmtorch.geometry.significance import counted_chances, counted_plane_chances, most_significant
from fmtorch.jit.kernel import Kernel

WITH_FOCALS: tuple[Kernel[..., Any], ...] = (
    five_point.five_point,  # solvers, samples and scores
    seven_point_kernel,
    counted_chances,
    refinement.near,
    sampling.draw,
    focal_prior.draw_depths,
    preselection.draw_by_prior,
    preselection.best,
    scores.score_gains,
    saturated.score_saturated,
    pair.normalize_pair,
    pair.to_pixels,
    support.support,
    inliers.residuals_squared,
    inliers.share_within,
    search.merge,
    saturated.saturated_cells,
    scored_matches.pack,
    sampling.quantise,
    focal_search.posteriors,
    focal_search.distinct_models,
    focal_search.same_model,
    cameras.centre,  # cameras and fits
    cameras.translate,
    with_focals.gain_without_prior,
    with_focals.refine_with_prior,
    model.cheirality,
    most_significant,
    cameras.nearest_cameras,
    levenberg_marquardt.evaluate,  # called by `minimise` and `refine`
    refine_kernel,
    posterior.minimise,
)
"""Of an estimator of fundamental matrices with the prior on focal lengths."""

OF_HOMOGRAPHIES: tuple[Kernel[..., Any], ...] = (
    homography_refine.refine_homographies,
    homography_refine.evaluate_homographies,
    four_point,
    homography.homography_to_pixels,
    inliers.residuals_squared_homography,
    refinement.near_homography,
    scores.score_gains_homography,
    saturated.score_saturated_homography,
    counted_plane_chances,
)
"""Of an estimator of homographies, beside those that the former has too."""
