"""Correspondences -> Estimate: robust estimation of fundamental matrices, and what a part of one's own is made of."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.compiling.arrays import F4x1, F4x2, F8x1, F8x2, I8x1, I8x2
    from fmtorch.compiling.kernel import kernel
    from fmtorch.estimators.coarse_to_fine import CoarseToFine
    from fmtorch.estimators.irls import IterativelyReweighted
    from fmtorch.estimators.pair import Pair
    from fmtorch.estimators.parts.scores import SummedGains
    from fmtorch.estimators.peers.authors import degensac_cpp, gc_ransac_cpp, magsac_cpp, superansac_cpp
    from fmtorch.estimators.peers.colmap import colmap
    from fmtorch.estimators.peers.kornia import kornia_ransac
    from fmtorch.estimators.peers.opencv import opencv
    from fmtorch.estimators.peers.pairwise import PairwiseEstimator
    from fmtorch.estimators.peers.poselib import poselib
    from fmtorch.estimators.ransac import Ransac

__all__ = [
    "CoarseToFine",
    "F4x1",
    "F4x2",
    "F8x1",
    "F8x2",
    "I8x1",
    "I8x2",
    "IterativelyReweighted",
    "Pair",
    "PairwiseEstimator",
    "Ransac",
    "SummedGains",
    "colmap",
    "degensac_cpp",
    "gc_ransac_cpp",
    "kernel",
    "kornia_ransac",
    "magsac_cpp",
    "opencv",
    "poselib",
    "superansac_cpp",
]

lazy_exports(__name__)
