"""Correspondences -> Estimate: robust estimation of fundamental matrices, and what a part of one's own is made of."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.estimators.batch import Batch
    from fmtorch.estimators.external.colmap import colmap
    from fmtorch.estimators.external.libraries import (
        degensac_cpp,
        fastpose,
        gc_ransac_cpp,
        kornia_ransac,
        magsac_cpp,
        opencv,
        poselib,
        superansac_cpp,
        weighted_eight_point,
    )
    from fmtorch.estimators.external.pairwise import PairwiseEstimator, Solution
    from fmtorch.estimators.focal_search import Focal
    from fmtorch.estimators.graph_cut import GraphCut
    from fmtorch.estimators.inliers import BetterHalf, InlierRule, RobustDeviations, StoppingRule, WithinThreshold
    from fmtorch.estimators.irls import IterativelyReweighted
    from fmtorch.estimators.models.fundamental import (
        EightPoint,
        FitScale,
        Fundamental,
        Homography,
        Hypotheses,
        SevenPoint,
    )
    from fmtorch.estimators.models.with_focals import BITS, cheirality
    from fmtorch.estimators.pair import MAX_NOISE, MIN_NOISE, Lens, Pair, bucket, uniforms
    from fmtorch.estimators.preselection import Preselect, Preselection
    from fmtorch.estimators.ransac import PARTS, WITH_FOCALS, CoarseToFine, Ransac, part
    from fmtorch.estimators.refinement import BestScore, Candidates, Refine, Refinement, Select, scores_of
    from fmtorch.estimators.sampling import PriorWeighted, Prosac, Sampler, Uniform, largest_weight
    from fmtorch.estimators.scores import (
        GemanMcClure,
        InlierCount,
        Magsac,
        Median,
        Msac,
        SaturatedGains,
        Score,
        SummedGains,
    )
    from fmtorch.estimators.search import Degensac, Pool, Search, Verified
    from fmtorch.jit.kernel import F4x1, F4x2, F8x1, F8x2, I8x1, I8x2, kernel

__all__ = [
    "BITS", "MAX_NOISE", "MIN_NOISE", "PARTS", "WITH_FOCALS", "Batch", "BestScore", "BetterHalf",
    "Candidates", "CoarseToFine", "Degensac", "EightPoint", "F4x1", "F4x2", "F8x1", "F8x2", "FitScale", "Focal",
    "Fundamental", "GemanMcClure", "GraphCut", "Homography", "Hypotheses", "I8x1", "I8x2", "InlierCount", "InlierRule",
    "IterativelyReweighted", "Lens", "Magsac", "Median", "Msac", "Pair", "PairwiseEstimator", "Pool",
    "Preselect", "Preselection", "PriorWeighted", "Prosac", "Ransac", "Refine", "Refinement", "RobustDeviations",
    "Sampler", "SaturatedGains", "Score", "Search", "Select", "SevenPoint", "Solution", "StoppingRule",
    "SummedGains", "Uniform", "Verified", "WithinThreshold", "bucket", "cheirality", "colmap", "degensac_cpp",
    "fastpose", "gc_ransac_cpp", "kernel", "kornia_ransac", "largest_weight", "magsac_cpp", "opencv",
    "part", "poselib", "scores_of", "superansac_cpp", "uniforms", "weighted_eight_point",
]  # fmt: skip

lazy_exports(__name__)
