"""Correspondences -> Correspondences: which matches survive."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.pruning.calibration import Calibration, Likely, MatchNoise, RatioPrior, match_noise
    from fmtorch.pruning.code import CODE, Coherence, LikelihoodField, SmoothMotion, coherence
    from fmtorch.pruning.consistency import FrameConsistency, PositionConsistency, frame_agreement, position_agreement
    from fmtorch.pruning.filters import GMS, MutualCheck, OneToOne, RatioTest, gms, gms_support, one_to_one, ratio_test
    from fmtorch.pruning.neighbors import LPM, lpm, lpm_cost
    from fmtorch.pruning.networks import DFE, LC, MatchInputs
    from fmtorch.pruning.networks.learned import LearnedPruner
    from fmtorch.pruning.refine_matches import RefineMatches

__all__ = [
    "CODE", "DFE", "GMS", "LC", "LPM", "Calibration", "Coherence", "FrameConsistency", "LearnedPruner",
    "LikelihoodField", "Likely", "MatchInputs", "MatchNoise", "MutualCheck", "OneToOne", "PositionConsistency",
    "RatioPrior", "RatioTest", "RefineMatches", "SmoothMotion", "coherence", "frame_agreement", "gms",
    "gms_support", "lpm", "lpm_cost", "match_noise", "one_to_one", "position_agreement", "ratio_test",
]  # fmt: skip

lazy_exports(__name__, checked=True)
