"""Correspondences -> Estimate: robust estimation of fundamental matrices."""

from fmtorch.estimators.adapters import (
    PairwiseEstimator,
    degensac_cpp,
    gc_ransac_cpp,
    kornia_ransac,
    magsac_cpp,
    opencv,
    poselib,
)
from fmtorch.estimators.engine import HypothesizeAndVerify

__all__ = [
    "HypothesizeAndVerify",
    "PairwiseEstimator",
    "degensac_cpp",
    "gc_ransac_cpp",
    "kornia_ransac",
    "magsac_cpp",
    "opencv",
    "poselib",
]
