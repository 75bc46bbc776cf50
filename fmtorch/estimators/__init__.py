"""Correspondences -> Estimate: robust estimation of fundamental matrices, and what a part of one's own is made of."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.estimators.coarse_to_fine import CoarseToFine
    from fmtorch.estimators.degensac import Degensac
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
    )
    from fmtorch.estimators.external.pairwise import PairwiseEstimator
    from fmtorch.estimators.graph_cut import GraphCut
    from fmtorch.estimators.inliers import BetterHalf, InlierRule, RobustDeviations, StoppingRule, WithinThreshold
    from fmtorch.estimators.irls import IterativelyReweighted
    from fmtorch.estimators.models.fundamental import EightPoint, Fundamental, Homography, SevenPoint
    from fmtorch.estimators.options import Focal, Preselect, Refine, Select
    from fmtorch.estimators.pair import Pair
    from fmtorch.estimators.ransac import Ransac
    from fmtorch.estimators.sampling import PriorWeighted, Prosac, Sampler, Uniform
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
    from fmtorch.jit.kernel import F4x1, F4x2, F8x1, F8x2, I8x1, I8x2, kernel

__all__ = [
    "BetterHalf", "CoarseToFine", "Degensac", "EightPoint", "F4x1", "F4x2", "F8x1", "F8x2", "Focal", "Fundamental",
    "GemanMcClure", "GraphCut", "Homography", "I8x1", "I8x2", "InlierCount", "InlierRule", "IterativelyReweighted",
    "Magsac", "Median", "Msac", "Pair", "PairwiseEstimator", "Preselect", "PriorWeighted", "Prosac", "Ransac", "Refine",
    "RobustDeviations", "Sampler", "SaturatedGains", "Score", "Select", "SevenPoint", "StoppingRule", "SummedGains",
    "Uniform", "WithinThreshold", "colmap", "degensac_cpp", "fastpose", "gc_ransac_cpp", "kernel", "kornia_ransac",
    "magsac_cpp", "opencv", "poselib", "superansac_cpp",
]  # fmt: skip

lazy_exports(__name__)
