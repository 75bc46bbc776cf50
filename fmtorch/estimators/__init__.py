"""Correspondences -> Estimate: robust estimation of fundamental matrices."""

from fmtorch.estimators.coarse_to_fine import CoarseToFine
from fmtorch.estimators.engine import HypothesizeAndVerify
from fmtorch.estimators.irls import IterativelyReweighted
from fmtorch.estimators.peers.authors import degensac_cpp, gc_ransac_cpp, magsac_cpp, superansac_cpp
from fmtorch.estimators.peers.kornia import kornia_ransac
from fmtorch.estimators.peers.opencv import opencv
from fmtorch.estimators.peers.pairwise import PairwiseEstimator
from fmtorch.estimators.peers.poselib import poselib

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
    "superansac_cpp",
]
