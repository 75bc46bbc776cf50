"""Kernels of an estimator with the prior on focal lengths, the slowest to compile first."""

from __future__ import annotations

from typing import Any

from fmtorch.compiling.kernel import Kernel
from fmtorch.estimators import focal_search, pair, search
from fmtorch.estimators.families import cameras, cheirality, focals, posterior
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
    refine_kernels,
    sampson_objective_kernels,
    seven_point_kernels,
    significance_kernels,
)

WITH_FOCALS: tuple[Kernel[..., Any], ...] = (
    five_point_kernels.five_point,
    sampson_objective_kernels.evaluate,  # called by `minimise` and `refine`
    seven_point_kernels.seven_point,
    posterior.minimise,
    refine_kernels.refine,
    cameras.nearest_cameras,
    significance_kernels.counted_chances,
    pair.normalize_pair,
    sampling.draw,
    cheirality.cheirality,
    scores.score_gains,
    saturated.score_saturated,
    pair.to_pixels,
    support.support,
    inliers.residuals_squared,
    preselection.best,
    cameras.translate,
    search.merge,
    refinement.near,
    focals.gain_without_prior,
    saturated.saturated_cells,
    focals.draw_depths,
    focals.refine_with_prior,
    significance_kernels.most_significant,
    preselection.draw_by_prior,
    inliers.share_within,
    cameras.centre,
    scored_matches.pack,
    sampling.quantise,
    focal_search.posteriors,
    focal_search.distinct_models,
    focal_search.same_model,
)
