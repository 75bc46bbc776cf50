"""Kernels that two processes compile side by side, by what they share, the slowest to compile at both ends."""

from __future__ import annotations

from typing import Any

from fmtorch.compiling.kernel import Kernel
from fmtorch.estimators import focal_search, pair, search
from fmtorch.estimators.families import cameras, cheirality, focal_prior, focals, homography, posterior
from fmtorch.estimators.parts import (
    inliers,
    preselection,
    refinement,
    sampling,
    saturated,
    scored_matches,
    scores,
    support,
)
from fmtorch.geometry import (
    five_point_kernels,
    four_point_kernels,
    homography_objective_kernels,
    refine_kernels,
    sampson_objective_kernels,
    seven_point_kernels,
    significance_kernels,
)

WITH_FOCALS: tuple[Kernel[..., Any], ...] = (
    five_point_kernels.five_point,  # solvers, samples and scores
    seven_point_kernels.seven_point,
    significance_kernels.counted_chances,
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
    focals.gain_without_prior,
    focals.refine_with_prior,
    cheirality.cheirality,
    significance_kernels.most_significant,
    cameras.nearest_cameras,
    sampson_objective_kernels.evaluate,  # called by `minimise` and `refine`
    refine_kernels.refine,
    posterior.minimise,
)
"""Of an estimator of fundamental matrices with the prior on focal lengths."""

OF_HOMOGRAPHIES: tuple[Kernel[..., Any], ...] = (
    homography_objective_kernels.refine_homographies,
    homography_objective_kernels.evaluate_homographies,
    four_point_kernels.four_point,
    homography.homography_to_pixels,
    inliers.residuals_squared_homography,
    refinement.near_homography,
    scores.score_gains_homography,
    saturated.score_saturated_homography,
)
"""Of an estimator of homographies, beside those that the former has too."""
