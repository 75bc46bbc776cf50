"""Kernels to be compiled together: of estimators with the prior on focal lengths, and of the pruners before them."""

from __future__ import annotations

import functools
from typing import Any

from fmtorch.compiling.kernel import Kernel
from fmtorch.compiling.together import compile_together
from fmtorch.estimators import (
    pairs_kernels,
    pool_kernels,
    sampling_kernels,
    scores_kernels,
    solvers_kernels,
    support_kernels,
    verify_kernels,
)
from fmtorch.estimators.focal import (
    cameras_kernels,
    cheirality_kernels,
    fit_kernels,
    hypotheses_kernels,
    posterior_kernels,
    refined_kernels,
    round_kernels,
    selection_kernels,
)
from fmtorch.geometry import (
    five_point_kernels,
    refine_kernels,
    sampson_objective_kernels,
    seven_point_kernels,
    significance_kernels,
)
from fmtorch.pruning import calibration_kernels, frame_consistency_kernels, position_consistency_kernels

FOCAL: tuple[Kernel[..., Any], ...] = (  # the slowest to compile first
    five_point_kernels.five_point,
    sampson_objective_kernels.evaluate,  # called by `minimise` and `refine`
    seven_point_kernels.seven_point,
    posterior_kernels.minimise,
    refine_kernels.refine,
    cameras_kernels.nearest_cameras,
    significance_kernels.counted_chances,
    pairs_kernels.normalize,
    sampling_kernels.draw,
    cheirality_kernels.share_in_front,
    scores_kernels.score_gains,
    scores_kernels.score_saturated,
    pairs_kernels.to_pixels,
    support_kernels.support,
    pool_kernels.residuals_squared,
    pool_kernels.best,
    cameras_kernels.translate,
    pool_kernels.merge,
    pool_kernels.near,
    fit_kernels.gain_without_prior,
    scores_kernels.saturated_cells,
    hypotheses_kernels.draw_depths,
    hypotheses_kernels.samples_of_five,
    round_kernels.candidates_of_five,
    solvers_kernels.samples_of_seven,
    verify_kernels.verify_by_saturated_gains,
    refined_kernels.refine_with_prior,
    refined_kernels.refine_near_with_prior,
    significance_kernels.most_significant,
    posterior_kernels.models_and_costs,
    pool_kernels.drawn_by_prior,
    pool_kernels.share_within,
    pool_kernels.within,
    cameras_kernels.centre,
    scores_kernels.matches,
    sampling_kernels.quantise,
    selection_kernels.posteriors,
    selection_kernels.rivals,
)

PRIORS: dict[str, tuple[Kernel[..., Any], ...]] = {  # by the names of the pruners
    "position_consistency": (position_consistency_kernels.position_agreement, calibration_kernels.calibrated),
    "frame_consistency": (frame_consistency_kernels.frame_agreement, frame_consistency_kernels.frame_prior),
}


@functools.cache
def compiled(prior: str = "") -> None:
    """Have the kernels ready of an estimator with the prior on focal lengths, and those of a pruner before it.

    Raises ImportError where numba cannot be imported.
    """
    compile_together((*PRIORS.get(prior, ()), *FOCAL))
