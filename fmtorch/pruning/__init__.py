"""Correspondences -> Correspondences: which matches survive."""

from fmtorch.pruning.mutual import mutual
from fmtorch.pruning.one_to_one import OneToOne, one_to_one
from fmtorch.pruning.ratio import RatioTest, ratio_test

__all__ = ["OneToOne", "RatioTest", "mutual", "one_to_one", "ratio_test"]
