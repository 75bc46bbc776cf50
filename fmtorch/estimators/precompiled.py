"""Kernels that two processes compile side by side, by what they share, the slowest to compile at both ends."""

from __future__ import annotations

from typing import Any

from fmtorch.estimators import focal_search, inliers, pair, preselection, refinement, sampling, scores, search
from fmtorch.estimators.lens_search import inverted, minimise_with_lenses
from fmtorch.estimators.models import focal_prior, fundamental, model, posterior, with_focals
from fmtorch.geometry import five_point, homography_refine, levenberg_marquardt
from fmtorch.geometry.homography import four_point
from fmtorch.geometry.refine import refine_kernel
from fmtorch.geometry.seven_point import seven_point_kernel
from fmtorch.geometry.significance import counted_chances, counted_plane_chances, most_significant
from fmtorch.jit.kernel import Kernel

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
