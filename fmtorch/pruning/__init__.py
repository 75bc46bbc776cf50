"""Correspondences -> Correspondences: which matches survive."""

from fmtorch.pruning.code import CODE, Coherence, LikelihoodField, SmoothMotion, code, coherence
from fmtorch.pruning.frame_consistency import FrameConsistency, frame_agreement
from fmtorch.pruning.gms import GMS, gms
from fmtorch.pruning.likely import Likely
from fmtorch.pruning.lpm import LPM, lpm
from fmtorch.pruning.mutual import mutual
from fmtorch.pruning.one_to_one import OneToOne, one_to_one
from fmtorch.pruning.ratio import RatioTest, ratio_test

__all__ = [
    "CODE",
    "GMS",
    "LPM",
    "Coherence",
    "FrameConsistency",
    "LikelihoodField",
    "Likely",
    "OneToOne",
    "RatioTest",
    "SmoothMotion",
    "code",
    "coherence",
    "frame_agreement",
    "gms",
    "lpm",
    "mutual",
    "one_to_one",
    "ratio_test",
]
