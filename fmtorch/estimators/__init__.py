"""Correspondences -> Estimate: robust estimation of fundamental matrices, and what a part of one's own is made of."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.estimators.coarse_to_fine import CoarseToFine
    from fmtorch.estimators.external.colmap import colmap
    from fmtorch.estimators.external.libraries import (
        degensac_cpp,
        gc_ransac_cpp,
        kornia_ransac,
        magsac_cpp,
        opencv,
        superansac_cpp,
    )
    from fmtorch.estimators.external.pairwise import PairwiseEstimator
    from fmtorch.estimators.external.poselib import poselib
    from fmtorch.estimators.irls import IterativelyReweighted
    from fmtorch.estimators.pair import Pair
    from fmtorch.estimators.ransac import Ransac
    from fmtorch.estimators.scores import SummedGains
    from fmtorch.jit.kernel import F4x1, F4x2, F8x1, F8x2, I8x1, I8x2, kernel

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
