"""Correspondences -> Estimate: robust estimation of fundamental matrices."""

from fmtorch.estimators.adapters import PairwiseEstimator, opencv, poselib
from fmtorch.estimators.engine import HypothesizeAndVerify

__all__ = ["HypothesizeAndVerify", "PairwiseEstimator", "opencv", "poselib"]
