"""Correspondences -> Estimate: robust estimation of fundamental matrices."""

from fmtorch.estimators.adapters import (
    PairwiseEstimator,
    degensac_cpp,
    gc_ransac_cpp,
    kornia_ransac,
    magsac_cpp,
    opencv,
    poselib,
    poselib_shared_focal,
)
from fmtorch.estimators.coarse_to_fine import CoarseToFine
from fmtorch.estimators.engine import HypothesizeAndVerify
from fmtorch.estimators.irls import IterativelyReweighted

__all__ = [
    "CoarseToFine",
    "HypothesizeAndVerify",
    "IterativelyReweighted",
    "PairwiseEstimator",
    "degensac_cpp",
    "gc_ransac_cpp",
    "kornia_ransac",
    "magsac_cpp",
    "opencv",
    "poselib",
    "poselib_shared_focal",
]
