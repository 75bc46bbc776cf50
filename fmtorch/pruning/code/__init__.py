"""CODE: two robust regressions over the match domain decide which matches are coherent."""

from fmtorch.pruning.code.domain import MatchDomain, match_domain
from fmtorch.pruning.code.likelihood import LikelihoodField
from fmtorch.pruning.code.motion import SmoothMotion
from fmtorch.pruning.code.regression import huber_regression
from fmtorch.pruning.code.stage import CODE, Coherence, code, coherence

__all__ = [
    "CODE",
    "Coherence",
    "LikelihoodField",
    "MatchDomain",
    "SmoothMotion",
    "code",
    "coherence",
    "huber_regression",
    "match_domain",
]
