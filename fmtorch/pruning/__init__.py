"""Correspondences -> Correspondences: which matches survive."""

from fmtorch.core.checks import public
from fmtorch.pruning.calibration import Calibration, RatioPrior
from fmtorch.pruning.code import CODE, Coherence, LikelihoodField, SmoothMotion
from fmtorch.pruning.code import code as _code
from fmtorch.pruning.code import coherence as _coherence
from fmtorch.pruning.frame_consistency import FrameConsistency
from fmtorch.pruning.frame_consistency import frame_agreement as _frame_agreement
from fmtorch.pruning.gms import GMS
from fmtorch.pruning.gms import gms as _gms
from fmtorch.pruning.gms import gms_support as _gms_support
from fmtorch.pruning.learned import LearnedPruner
from fmtorch.pruning.likely import Likely
from fmtorch.pruning.lpm import LPM
from fmtorch.pruning.lpm import lpm as _lpm
from fmtorch.pruning.lpm import lpm_cost as _lpm_cost
from fmtorch.pruning.match_noise import MatchNoise
from fmtorch.pruning.match_noise import match_noise as _match_noise
from fmtorch.pruning.mutual import MutualCheck
from fmtorch.pruning.mutual import mutual as _mutual
from fmtorch.pruning.one_to_one import OneToOne
from fmtorch.pruning.one_to_one import one_to_one as _one_to_one
from fmtorch.pruning.position_consistency import PositionConsistency
from fmtorch.pruning.position_consistency import position_agreement as _position_agreement
from fmtorch.pruning.ratio import RatioTest
from fmtorch.pruning.ratio import ratio_test as _ratio_test

_public = public(__name__)
code = _public(_code)
coherence = _public(_coherence)
frame_agreement = _public(_frame_agreement)
gms = _public(_gms)
gms_support = _public(_gms_support)
lpm = _public(_lpm)
lpm_cost = _public(_lpm_cost)
match_noise = _public(_match_noise)
mutual = _public(_mutual)
one_to_one = _public(_one_to_one)
position_agreement = _public(_position_agreement)
ratio_test = _public(_ratio_test)

__all__ = [
    "CODE",
    "GMS",
    "LPM",
    "Calibration",
    "Coherence",
    "FrameConsistency",
    "LearnedPruner",
    "LikelihoodField",
    "Likely",
    "MatchNoise",
    "MutualCheck",
    "OneToOne",
    "PositionConsistency",
    "RatioPrior",
    "RatioTest",
    "SmoothMotion",
    "code",
    "coherence",
    "frame_agreement",
    "gms",
    "gms_support",
    "lpm",
    "lpm_cost",
    "match_noise",
    "mutual",
    "one_to_one",
    "position_agreement",
    "ratio_test",
]
